# SPDX-License-Identifier: MIT
"""Linear layers. Large float32 ones on the CPU are computed by oneDNN, which torch itself asks only for bfloat16.

torch's own choice, MKL, leaves processors that are not Intel's far below what they can do: on an AMD EPYC with AVX-512
oneDNN is 2 to 3 times as fast (docs/performance.md). The operation is the one that torch.compile puts in. It is made
for each shape, which takes a while the first time: ReWiND's tokens come in few shapes (``packing.rounded_up``).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

WORTH_ONEDNN = 1 << 21  # multiplications; of fewer, to begin costs more than is gained


class Linear(nn.Linear):
    """An ``nn.Linear`` that multiplies by the function ``linear``."""

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
