# SPDX-License-Identifier: MIT
"""Parts of networks that more than one family has, and the precision in which they compute."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor, nn

WORTH_ONEDNN = 1 << 21  # multiplications; of fewer, to begin costs more than is gained


class Linear(nn.Linear):
    """An ``nn.Linear`` whose large float32 products on the CPU are computed by oneDNN.

    torch asks oneDNN only for bfloat16, but MKL is slow on processors other than Intel's
    (docs/explanation/performance.md). The operation is that of torch.compile. oneDNN builds a kernel for each new
    shape, so ReWiND's tokens come in few shapes (``rfm.rewind.network.rounded_up``).
    """

    def forward(self, input: Tensor, *, relu: bool = False, plus: Tensor | None = None) -> Tensor:
        """[..., K] -> [..., N]."""
        return linear(input, self.weight, self.bias, relu=relu, plus=plus)


def linear(x: Tensor, weight: Tensor, bias: Tensor | None, *, relu: bool = False, plus: Tensor | None = None) -> Tensor:
    """``x @ weight.T + bias``: [..., K], [N, K] and [N] -> [..., N]; then ReLU, or ``plus`` [..., N] added."""
    if _by_onednn(x, weight, bias):
        onednn = torch.ops.mkldnn._linear_pointwise
        if plus is not None:
            return onednn.binary(x, plus, weight, bias, "add")
        product = onednn.default(x, weight, bias, "none", [], "")
        return product.relu_() if relu else product  # oneDNN's own ReLU makes 0 of NaN, which would hide it
    product = F.linear(x, weight, bias)
    if plus is not None:
        return product + plus
    return F.relu(product) if relu else product


def speed_up(network: nn.Module) -> None:
    """Puts ``Linear`` in place of every ``nn.Linear``, with the same parameters."""
    for module in network.modules():
        for name, child in module.named_children():
            if type(child) is nn.Linear:
                with torch.device("meta"):
                    faster = Linear(child.in_features, child.out_features, child.bias is not None)
                faster.weight, faster.bias = child.weight, child.bias
                setattr(module, name, faster)


def _by_onednn(x: Tensor, weight: Tensor, bias: Tensor | None) -> bool:
    """Whether oneDNN computes the product: it has no gradient, and needs a bias without gaps in memory."""
    return (
        x.device.type == "cpu"
        and x.dtype is torch.float32
        and weight.dtype is torch.float32
        and x.numel() * len(weight) >= WORTH_ONEDNN
        and (bias is None or bias.is_contiguous())
        and not torch.is_grad_enabled()
        and torch.backends.mkldnn.is_available()
    )


class PredictionHead(nn.Sequential):
    """[..., D] hidden states -> [..., n] logits. The indices 0, 1 and 4 are the names in checkpoints."""

    def __init__(self, hidden_dim: int, num_outputs: int) -> None:
        super().__init__(
            Linear(hidden_dim, hidden_dim // 2),
            nn.LayerNorm(hidden_dim // 2),
            nn.GELU(),
            nn.Dropout(),  # holds its index; serving never trains
            Linear(hidden_dim // 2, num_outputs),
        )


def progress_from_logits(logits: Tensor) -> Tensor:
    """float32 [...] in 0..1 from the progress head's [..., n].

    n = 1: the sigmoid. n = K bins: the mean of the bins' centres linspace(0, 1, K) under the softmax,
    in float32 whatever the model's precision.
    """
    if logits.shape[-1] == 1:
        return logits.squeeze(-1).sigmoid().float()
    bins = torch.linspace(0.0, 1.0, logits.shape[-1], device=logits.device)
    return logits.float().softmax(dim=-1) @ bins


def as_tensor(array: npt.NDArray[Any]) -> Tensor:
    """The array as a tensor; a copy only where torch cannot share its memory (read-only, reversed)."""
    return torch.from_numpy(np.require(array, requirements=("C", "W")))


# What PyTorch has MKL compute on a CPU: IMPLEMENT_VML_MKL in its ATen/cpu/vml.h.
MKL_FUNCTIONS = (
    torch.acos,
    torch.asin,
    torch.atan,
    torch.cos,
    torch.erf,
    torch.erfc,
    torch.erfinv,
    torch.exp,
    torch.log,
    torch.log10,
    torch.log2,
    torch.sin,
    torch.sqrt,
    torch.tan,
    torch.tanh,
    torch.trunc,
)


def keep_float32() -> None:
    """Has GPUs and CPUs compute float32 as float32. To be called before they compute anything.

    GPU: PyTorch has cuDNN round what a convolution reads to TF32, with 10 bits of 23, which moves scores by more than
    1e-5.
    CPU: MKL 2024.2 chooses the code of a function at its first call. If several threads make that call together, one of
    them may compute its part with less exact code, and a cosine is 1.5e-4 off (pytorch/pytorch#188792). So one thread
    makes the first calls here.
    """
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False
    _call_each_once()


@cache
def _call_each_once() -> None:
    for dtype in (torch.float32, torch.float64):
        for function in MKL_FUNCTIONS:
            function(torch.zeros(1, dtype=dtype))
