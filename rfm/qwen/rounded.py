# SPDX-License-Identifier: MIT
"""Linear layers with 8-bit or 4-bit weights. Each forward pass decodes them; inputs and products are not rounded.

So a row's scores do not depend on other rows in its batch, as they would with rounded inputs. N outputs and K inputs
per layer.

int8: weight int8 [N, K] and scale [N, 1]; a value is weight * scale.
nf4: weight uint8 [N, K / 2], two codes per byte, and scale float32 [blocks], described in ``rfm.published.rounding``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from rfm.config import Weights
from rfm.engine.layers import linear
from rfm.files import CheckpointError
from rfm.weights import DECODED, SCALE, VALUES_PER_BYTE

# The layers that may be rounded: linear layers in the language model and the vision tower. They hold nine tenths of a
# network's weight bytes; the embedding, the heads and the layers between the two parts stay unrounded.
_LAYER = re.compile(r"\.(layers|blocks)\.\d+\..*\.weight")
_MOST = 127  # int8 limit, so that zero is in the middle
INSTALL = 'pip install ".[quantized]"'


class RoundedLinear(nn.Module):
    """An ``nn.Linear`` with a rounded weight and optional LoRA factors beside it, as in PEFT."""

    weight: Tensor
    scale: Tensor
    lora_A: nn.Linear | None  # noqa: N815  PEFT's name
    lora_B: nn.Linear | None  # noqa: N815

    def __init__(self, layer: nn.Linear, rank: int | None) -> None:
        super().__init__()
        self.in_features, self.out_features = layer.in_features, layer.out_features
        self.bias = layer.bias
        self.lora_A = self.lora_B = None
        if rank is not None:
            self.lora_A = nn.Linear(self.in_features, rank, bias=False, device="meta")
            self.lora_B = nn.Linear(rank, self.out_features, bias=False, device="meta")

    def forward(self, input: Tensor) -> Tensor:
        """Float [..., K] -> [..., N]."""
        plus = None if self.lora_A is None or self.lora_B is None else self.lora_B(self.lora_A(input))
        return linear(input, self.values(input.dtype), self.bias, plus=plus)

    def values(self, dtype: torch.dtype) -> Tensor:
        """Return the decoded weight, [N, K]."""
        raise NotImplementedError


class Int8Linear(RoundedLinear):
    """A linear layer with 8 bits per value, and one scale per output."""

    def __init__(self, layer: nn.Linear, scale: Tensor, rank: int | None) -> None:
        super().__init__(layer, rank)
        shape = self.out_features, self.in_features
        self.register_buffer("weight", torch.empty(shape, dtype=torch.int8, device="meta"))
        self.register_buffer("scale", torch.empty(self.out_features, 1, dtype=scale.dtype, device="meta"))

    def values(self, dtype: torch.dtype) -> Tensor:
        """Return the decoded weight, [N, K]."""
        return (self.weight * self.scale).to(dtype)


class Nf4Linear(RoundedLinear):
    """A linear layer in NF4, which bitsandbytes decodes. ``decoded``: empty, in the decoded values' dtype."""

    decoded: Tensor

    def __init__(self, layer: nn.Linear, scale: Tensor, decoded: Tensor, rank: int | None) -> None:
        super().__init__(layer, rank)
        self._bitsandbytes = _bitsandbytes()
        count = self.out_features * self.in_features
        # The power of 2 from which these scales result.
        self._block_size = max(NF4_BLOCK_SIZES[0], 1 << (math.ceil(count / len(scale)) - 1).bit_length())
        num_blocks = math.ceil(count / self._block_size)
        packed = self.out_features, self.in_features // VALUES_PER_BYTE
        self.register_buffer("weight", torch.empty(packed, dtype=torch.uint8, device="meta"))
        self.register_buffer("scale", torch.empty(num_blocks, dtype=torch.float32, device="meta"))
        self.register_buffer("decoded", torch.empty(0, dtype=decoded.dtype, device="meta"))

    def values(self, dtype: torch.dtype) -> Tensor:
        """Return the decoded weight, [N, K]."""
        state = self._bitsandbytes.QuantState(
            absmax=self.scale,
            # One row: on the CPU, bitsandbytes takes wrong scales for rows that are not whole blocks.
            shape=torch.Size([1, self.out_features * self.in_features]),
            dtype=self.decoded.dtype,
            blocksize=self._block_size,
            quant_type="nf4",
        )
        flat = self._bitsandbytes.dequantize_4bit(self.weight.view(-1, 1), state)
        return flat.view(self.out_features, self.in_features).to(dtype)


def _bitsandbytes() -> Any:
    try:
        from bitsandbytes import functional
    except ImportError as error:
        expected = "bitsandbytes, which decodes weights in NF4"
        raise CheckpointError.at("weights", expected, "none", INSTALL) from error
    return functional


def may_be_rounded(name: str) -> bool:
    """Return True if a weight with this name, also LoRA-wrapped, belongs to a layer that may be rounded."""
    return _LAYER.search(name) is not None


def is_rounded(name: str, tensor: Tensor) -> bool:
    """Return True if the tensor belongs to a rounded weight, which keeps its dtype in every network."""
    return not tensor.is_floating_point() or name.endswith((SCALE, DECODED))


def shape_of(weight: Tensor) -> list[int]:
    """Return the decoded shape of a weight, [N, K]."""
    rows, *columns = weight.shape
    return [rows, columns[0] * VALUES_PER_BYTE] if weight.dtype is torch.uint8 else [rows, *columns]


def fit(network: nn.Module, weights: Mapping[str, Tensor], factors: Mapping[str, Tensor] | None = None) -> None:
    """Replace the network's layers by rounded ones where the weights are rounded.

    factors: LoRA factors; those for rounded weights stay beside them
    Raises CheckpointError if bitsandbytes is missing.
    """
    modules = dict(network.named_modules())
    for path in (name.removesuffix(SCALE) for name in weights if name.endswith(SCALE)):
        layer = modules.get(path)
        if type(layer) is not nn.Linear:
            continue  # ``check_shapes`` reports the mismatch
        down = (factors or {}).get(f"{path}.lora_A.weight")
        rank = None if down is None else len(down)
        scale, decoded = weights[path + SCALE], weights.get(path + DECODED)
        rounded = Int8Linear(layer, scale, rank) if decoded is None else Nf4Linear(layer, scale, decoded, rank)
        parent, _, child = path.rpartition(".")
        setattr(modules[parent], child, rounded)


def rounded(name: str, weight: Tensor, kind: Weights, dtype: torch.dtype) -> dict[str, Tensor]:
    """Return the tensors for a rounded weight by name. Raises CheckpointError if bitsandbytes is missing for NF4.

    name: weight name, which ends in ``.weight``
    weight: float32 [N, K]
    dtype: type of decoded values
    """
    if kind == "nf4":
        codes, state = _bitsandbytes().quantize_4bit(weight, blocksize=_NF4_BLOCK_SIZE, quant_type="nf4")
        return of_layer(name, codes.view(len(weight), -1), state.absmax, dtype)
    scale = (weight.abs().amax(1, keepdim=True) / _MOST).to(dtype)
    steps = weight / torch.where(scale == 0, 1, scale).float()
    return {name: steps.round().clamp(-_MOST, _MOST).to(torch.int8), name.removesuffix(".weight") + SCALE: scale}


NF4_BLOCK_SIZES = [2**power for power in range(5, 13)]  # in bitsandbytes, for weights and scales
_NF4_BLOCK_SIZE = 64  # in ``rounded``
NF4_CODES = (
    -1.0, -0.6961928009986877, -0.5250730514526367, -0.39491748809814453, -0.28444138169288635, -0.18477343022823334,
    -0.09105003625154495, 0.0, 0.07958029955625534, 0.16093020141124725, 0.24611230194568634, 0.33791524171829224,
    0.44070982933044434, 0.5626170039176941, 0.7229568362236023, 1.0,
)  # fmt: skip


def of_layer(name: str, codes: Tensor, scales: Tensor, dtype: torch.dtype) -> dict[str, Tensor]:
    """Return a layer's tensors by name. name: weight name; dtype: type of decoded values."""
    path = name.removesuffix(".weight")
    return {name: codes, path + SCALE: scales, path + DECODED: torch.empty(0, dtype=dtype)}
