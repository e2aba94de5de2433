# SPDX-License-Identifier: MIT
"""Weights in NF4: 4 bits for each value, and a scale for each block.

A value is code * scale (https://arxiv.org/abs/2305.14314). Blocks continue across rows. Scales may be rounded too: to
8 bits, around an offset, with a scale for each block of scales.

bitsandbytes stores a weight as seven tensors. A layer of ``rfm.vlm.rounded`` has three: ``weight``, uint8 [N, K / 2],
with two codes a byte, the first in the higher bits; ``scale``, float32 [blocks]; ``decoded``, empty, in the dtype of
the decoded values.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from rfm.checkpoint.content import CheckpointError, shown
from rfm.checkpoint.weights import DECODED, SCALE, VALUES_OF_BYTE

_STATE = ".quant_state.bitsandbytes__nf4"  # behind a weight's name: JSON in bytes
_MAX_STATE_BYTES = 2**16
_DTYPES = {"bfloat16": torch.bfloat16, "float16": torch.float16, "float32": torch.float32}
_BLOCK_SIZES = [2**power for power in range(5, 13)]  # of bitsandbytes, for weights and scales
_BITS = 4  # of a value
_BLOCK_SIZE = 64  # of ``quantize``, bitsandbytes' default
_VALUES_AT_ONCE = 2**22  # more would take more memory and save no time
_CODES = (
    -1.0, -0.6961928009986877, -0.5250730514526367, -0.39491748809814453, -0.28444138169288635, -0.18477343022823334,
    -0.09105003625154495, 0.0, 0.07958029955625534, 0.16093020141124725, 0.24611230194568634, 0.33791524171829224,
    0.44070982933044434, 0.5626170039176941, 0.7229568362236023, 1.0,
)  # fmt: skip


def dequantize(tensors: dict[str, Tensor], stays: Callable[[str], bool] | None = None) -> int:
    """Replace NF4 weights by weights in their original dtype; return the number of NF4 weights.

    stays: True for the name of a weight that stays in NF4, as tensors of a layer; a weight of an odd number of columns
        never does
    Raises CheckpointError for a weight whose parts are missing or do not fit.
    """
    names = [name.removesuffix(_STATE) for name in tensors if name.endswith(_STATE)]
    for name in names:
        state = _state(name, tensors.pop(name + _STATE))
        is_matrix = len(state["shape"]) == 2 and state["shape"][1] % VALUES_OF_BYTE == 0
        packed, scales = _parts(name, state, tensors)
        if stays is not None and is_matrix and stays(name):
            tensors |= of_layer(name, packed.view(state["shape"][0], -1), scales, _DTYPES[state["dtype"]])
        else:
            tensors[name] = _decoded(packed, scales, state)
    return len(names)


def of_layer(name: str, codes: Tensor, scales: Tensor, dtype: torch.dtype) -> dict[str, Tensor]:
    """Return a layer's tensors by name. name: of the weight; dtype: of the decoded values"""
    path = name.removesuffix(".weight")
    return {name: codes, path + SCALE: scales, path + DECODED: torch.empty(0, dtype=dtype)}


def quantize(weight: Tensor) -> tuple[Tensor, Tensor]:
    """Round a weight, float32 [N, K] with an even K, to codes, uint8 [N, K / 2], and scales, float32 [blocks]."""
    blocks = pad(weight.flatten(), (0, -weight.numel() % _BLOCK_SIZE)).view(-1, _BLOCK_SIZE)
    scales = blocks.abs().amax(1)
    codes = torch.tensor(_CODES)
    middles = (codes[1:] + codes[:-1]) / 2
    shares = blocks / torch.where(scales == 0, 1, scales)[:, None]
    nearest = torch.bucketize(shares, middles, out_int32=True).to(torch.uint8).flatten()[: weight.numel()]
    return (nearest[0::2] << _BITS | nearest[1::2]).view(len(weight), -1), scales


def block_size(num_values: int, num_blocks: int) -> int:
    """Return the number of values of a block, a power of 2."""
    return max(_BLOCK_SIZES[0], 1 << (math.ceil(num_values / num_blocks) - 1).bit_length())


def _state(name: str, packed: Tensor) -> dict[str, Any]:
    try:
        if packed.dtype != torch.uint8 or packed.numel() > _MAX_STATE_BYTES:
            raise ValueError(f"{list(packed.shape)} of {packed.dtype}")
        state = json.loads(packed.numpy().tobytes())
        if not isinstance(state, dict):
            raise ValueError(shown(state))
    except (RecursionError, ValueError) as error:
        raise _misfit(name, f"{_STATE[1:]} in JSON", str(error)) from error
    shape = state.get("shape")
    if not (isinstance(shape, list) and shape and all(type(size) is int and size > 0 for size in shape)):
        raise _misfit(name, "the shape of the weight in its quant_state", shown(shape))
    allowed: Mapping[str, Any] = {"quant_type": ["nf4"], "dtype": [*_DTYPES], "blocksize": _BLOCK_SIZES}
    if "nested_offset" in state:
        allowed = {**allowed, "nested_dtype": ["float32"], "nested_blocksize": _BLOCK_SIZES}
        if type(state["nested_offset"]) is not float:
            raise _misfit(name, "a number as nested_offset of its quant_state", shown(state["nested_offset"]))
    for key, values in allowed.items():
        if type(state.get(key)) is not type(values[0]) or state[key] not in values:
            expected = f"{key} {' or '.join(map(str, values))} in its quant_state"
            raise _misfit(name, expected, shown(state.get(key)))
    return state


def _parts(name: str, state: Mapping[str, Any], tensors: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Return a weight's bytes, uint8 [values / 2], and scales, float32 [blocks]; remove its parts from ``tensors``."""

    def part(suffix: str, dtype: torch.dtype, length: int) -> Tensor:
        tensor = tensors.pop(name + suffix, None)
        if tensor is None or tensor.dtype != dtype or tensor.numel() != length:
            got = "none" if tensor is None else f"{tensor.numel()} of {tensor.dtype}"
            raise _misfit(name + suffix, f"{length} numbers of {dtype}", got)
        return tensor.flatten()

    count, size = math.prod(state["shape"]), state["blocksize"]
    blocks = math.ceil(count / size)
    codes = part(".quant_map", torch.float32, len(_CODES))
    if not torch.allclose(codes, torch.tensor(_CODES), rtol=0, atol=1e-6):
        raise _misfit(f"{name}.quant_map", "the codes of NF4", shown(codes.tolist()))
    if "nested_offset" in state:
        scale_codes = part(".nested_quant_map", torch.float32, 256)
        outer = part(".nested_absmax", torch.float32, math.ceil(blocks / state["nested_blocksize"]))
        outer = outer.repeat_interleave(state["nested_blocksize"])[:blocks]
        scales = scale_codes[part(".absmax", torch.uint8, blocks).int()] * outer + state["nested_offset"]
    else:
        scales = part(".absmax", torch.float32, blocks)
    return part("", torch.uint8, (count + 1) // VALUES_OF_BYTE), scales


def _decoded(packed: Tensor, scales: Tensor, state: Mapping[str, Any]) -> Tensor:
    """Return a weight's values, from its bytes and scales."""
    count, size, blocks = math.prod(state["shape"]), state["blocksize"], len(scales)
    packed = pad(packed, (0, (blocks * size - count) // VALUES_OF_BYTE))
    codes = torch.tensor(_CODES)
    pairs = torch.cartesian_prod(codes, codes)  # the two values of each byte, the higher bits first
    whole = torch.empty(blocks, size, dtype=_DTYPES[state["dtype"]])
    step = _VALUES_AT_ONCE // size
    for start in range(0, blocks, step):
        some = packed[start * size // 2 : (start + step) * size // 2].int()
        whole[start : start + step] = pairs.index_select(0, some).view(-1, size) * scales[start : start + step, None]
    return whole.flatten()[:count].view(state["shape"])


def _misfit(name: str, expected: str, got: str) -> CheckpointError:
    remedy = "copy this checkpoint again, or export the full checkpoint that was rounded to NF4"
    return CheckpointError.at(name, expected, got, remedy)
