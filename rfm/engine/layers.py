# SPDX-License-Identifier: MIT
"""Layers shared by several families, pixel normalisation, and computation precision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rfm.files import MAX_UINT8

Plan = TypeVar("Plan", bound=Any)
WORTH_ONEDNN = 1 << 21  # multiplications; for fewer, starting oneDNN costs more than it saves


class Linear(nn.Linear):
    """An ``nn.Linear`` that computes large float32 products on the CPU with oneDNN.

    PyTorch uses MKL, which is slow on processors other than Intel's (docs/explanation/performance.md), and oneDNN only
    for bfloat16. torch.compile uses the same operation. oneDNN builds a kernel for each new shape, so ReWiND pads
    tokens to few shapes (``rfm.families.rewind.network.rounded_up``).
    """

    def forward(self, input: Tensor, *, relu: bool = False, plus: Tensor | None = None) -> Tensor:
        """Float [..., in_features] -> [..., out_features]; then ReLU, or ``plus`` added."""
        return linear(input, self.weight, self.bias, relu=relu, plus=plus)


def linear(x: Tensor, weight: Tensor, bias: Tensor | None, *, relu: bool = False, plus: Tensor | None = None) -> Tensor:
    """Return ``x @ weight.T + bias``, then ReLU, or with ``plus`` added; x: [..., D], weight: [N, D], bias: [N].

    plus and the result: [..., N]
    """
    if _by_onednn(x, weight, bias):
        onednn, (source, packed) = torch.ops.mkldnn._linear_pointwise, vars(weight).get("packed", (None, None))
        weight = packed if source and source == _source(weight) else weight
        if plus is not None:
            return onednn.binary(x, plus, weight, bias, "add")
        product = onednn.default(x, weight, bias, "none", [], "")
        return product.relu_() if relu else product  # oneDNN's own ReLU turns NaN into 0, which would hide it
    product = F.linear(x, weight, bias)
    if plus is not None:
        return product + plus
    return F.relu(product) if relu else product


def pack(network: nn.Module) -> None:
    """Copy float32 matrices on the CPU to oneDNN's layout, once instead of in each product, until they change."""
    for part in network.parameters():
        if part.ndim == 2 and part.is_cpu and part.dtype is torch.float32 and torch.backends.mkldnn.is_available():
            vars(part)["packed"] = _source(part), torch.ops.mkldnn._reorder_linear_weight(part.detach())


def _source(weight: Tensor) -> tuple[int, int]:
    return weight.data_ptr(), weight._version


class RmsNorm(nn.Module):
    """Transformers' RMSNorm in two kernels instead of eight, with the same roundings.

    The input is normalised in float32 and rounded to its dtype, then multiplied by the weight.
    """

    def __init__(self, weight: nn.Parameter, eps: float) -> None:
        super().__init__()
        self.weight, self.eps = weight, eps

    def forward(self, x: Tensor) -> Tensor:
        """Float [..., D] -> [..., D]."""
        return self.weight * F.rms_norm(x, self.weight.shape[-1:], None, self.eps)


def speed_up(network: nn.Module) -> None:
    """Replace layers by faster ones with the same parameters.

    On the CPU, ``Linear`` replaces every float32 ``nn.Linear``. On other devices, ``RmsNorm`` replaces transformers'
    RMSNorms; on the CPU ``F.rms_norm`` is slower in bfloat16.
    """
    for module in network.modules():
        for name, child in module.named_children():
            if type(child) is nn.Linear and child.weight.is_cpu and child.weight.dtype is torch.float32:
                with torch.device("meta"):
                    faster = Linear(child.in_features, child.out_features, child.bias is not None)
                faster.weight, faster.bias = child.weight, child.bias
                setattr(module, name, faster)
            elif is_rms_norm(child) and (weight := child.get_parameter("weight")).device.type != "cpu":
                setattr(module, name, RmsNorm(weight, float(child.variance_epsilon)))  # type: ignore[arg-type]  # a float


def is_rms_norm(module: nn.Module) -> bool:
    """True for an RMSNorm from transformers, which has one class for each backbone."""
    return type(module).__name__.endswith("RMSNorm") and hasattr(module, "variance_epsilon")


def _by_onednn(x: Tensor, weight: Tensor, bias: Tensor | None) -> bool:
    """True if oneDNN computes the product: it computes no gradients, and needs a contiguous bias."""
    return (
        x.is_cpu
        and x.dtype is torch.float32
        and weight.dtype is torch.float32
        and x.numel() * weight.shape[0] >= WORTH_ONEDNN
        and (bias is None or bias.is_contiguous())
        and not torch.is_grad_enabled()
        and torch.backends.mkldnn.is_available()
    )


class PredictionHead(nn.Sequential):
    """Hidden states [..., D] -> logits [..., N]. Checkpoints name the layers by their indices 0, 1 and 4."""

    def __init__(self, hidden_dim: int, num_outputs: int) -> None:
        super().__init__(
            Linear(hidden_dim, hidden_dim // 2),
            nn.LayerNorm(hidden_dim // 2),
            nn.GELU(),
            nn.Dropout(),  # keeps index 4 for the last layer; serving never trains
            Linear(hidden_dim // 2, num_outputs),
        )


def progress_from_logits(logits: Tensor) -> Tensor:
    """Return progress, float32 [...] from 0 to 1, from progress logits [..., K].

    K = 1: the sigmoid. K > 1 bins: the mean of the bin centres linspace(0, 1, K) under the softmax, in float32 for
    every model dtype.
    """
    if logits.shape[-1] == 1:
        return logits.squeeze(-1).sigmoid().float()
    bins = torch.linspace(0.0, 1.0, logits.shape[-1], device=logits.device)
    return logits.float().softmax(dim=-1) @ bins


def changed(plan: Plan, change: Callable[[Tensor], Tensor]) -> Plan:
    """Return a dataclass with ``change`` applied to its tensors."""
    tensors: dict[str, Any] = {name: change(each) for name, each in vars(plan).items() if isinstance(each, Tensor)}
    return replace(plan, **tensors)


def concatenated(parts: Sequence[Tensor]) -> Tensor:
    """Concatenate the parts along their first axis; return a single part as it is, without a copy."""
    return torch.cat(list(parts)) if len(parts) > 1 else parts[0]


def as_tensor(array: npt.NDArray[Any]) -> Tensor:
    """Return the array as a tensor; it shares the array's memory unless that is read-only or not C-contiguous."""
    return torch.from_numpy(np.require(array, requirements=("C", "W")))


# The functions that PyTorch computes with MKL on a CPU: IMPLEMENT_VML_MKL in its ATen/cpu/vml.h.
MKL_FUNCTIONS = (
    torch.acos, torch.asin, torch.atan, torch.cos, torch.erf, torch.erfc, torch.erfinv, torch.exp, torch.log,
    torch.log10, torch.log2, torch.sin, torch.sqrt, torch.tan, torch.tanh, torch.trunc,
)  # fmt: skip


def keep_float32() -> None:
    """Make GPUs and CPUs compute float32 in full precision; to be called before any computation.

    GPU: by default cuDNN rounds convolution inputs to TF32 (10 of 23 mantissa bits), which changes scores by more than
    1e-5.
    CPU: MKL 2024.2 selects a function's code at its first call. If threads make that call at once, one may use less
    exact code: a cosine is off by 1.5e-4 (pytorch/pytorch#188792). Here a single thread makes the first calls.
    """
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False
    _call_each_once()


@cache
def _call_each_once() -> None:
    for dtype in (torch.float32, torch.float64):
        for function in MKL_FUNCTIONS:
            function(torch.zeros(1, dtype=dtype))


@dataclass(frozen=True)
class Normalisation:
    """Normalise pixels per channel, on the network's device: (value - 255 mean) / (255 std)."""

    mean: tuple[float, ...]
    std: tuple[float, ...]

    def to_config(self) -> dict[str, Any]:
        """Return the corresponding fields for preprocessor_config.json."""
        return {"image_mean": self.mean, "image_std": self.std, "rescale_factor": 1 / MAX_UINT8}

    def __call__(self, frames: Tensor) -> Tensor:
        """Normalise pixels: uint8 or float [..., H, W, C] -> float32 [..., C, H, W]."""
        mean, std = (_channels(values, frames.device) for values in (self.mean, self.std))
        return frames.movedim(-1, -3).to(torch.float32, copy=True).sub_(mean).div_(std)


@lru_cache
def _channels(values: tuple[float, ...], device: torch.device) -> Tensor:
    """Return values from 0 to 1 as grey levels, float32 [C, 1, 1], cached on the device."""
    return (torch.tensor(values).view(-1, 1, 1) * MAX_UINT8).to(device)
