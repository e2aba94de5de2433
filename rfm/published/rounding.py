# SPDX-License-Identifier: MIT
"""Checkpoints with rounded weights: rounded here (``rfm export --weights``), or published in NF4.

NF4 is as bitsandbytes stores it: seven tensors per weight. Scales may be rounded too: to 8 bits, around an offset, with
one scale per block of scales.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from rfm.config import Weights
from rfm.engine.family import Checkpoint
from rfm.files import NETWORK_CONFIG, CheckpointError, shown
from rfm.published.qwen import NF4, QUANTIZED, UNQUANTIZED, check_not_quantized, quantization
from rfm.published.weights import read_weights
from rfm.qwen.checkpoint import LORA, QwenCheckpoint
from rfm.qwen.lora import changed_by, merged
from rfm.qwen.rounded import NF4_BLOCK_SIZES, NF4_CODES, may_be_rounded, of_layer, rounded
from rfm.weights import DECODED, VALUES_PER_BYTE

_STATE = ".quant_state.bitsandbytes__nf4"  # behind a weight's name: JSON in bytes
_MAX_STATE_BYTES = 2**16
_DTYPES = {"bfloat16": torch.bfloat16, "float16": torch.float16, "float32": torch.float32}
_VALUES_AT_ONCE = 2**22  # more would take more memory and save no time


def dequantize(tensors: dict[str, Tensor], stays: Callable[[str], bool] | None = None) -> int:
    """Replace NF4 weights by weights in their original dtype; return how many NF4 weights there were.

    stays: True for the name of a weight that stays in NF4, as a layer's tensors; a weight with an odd number of columns
        never stays
    Raises CheckpointError for a weight whose parts are missing or do not fit.
    """
    names = [name.removesuffix(_STATE) for name in tensors if name.endswith(_STATE)]
    for name in names:
        state = _state(name, tensors.pop(name + _STATE))
        is_matrix = len(state["shape"]) == 2 and state["shape"][1] % VALUES_PER_BYTE == 0
        packed, scales = _parts(name, state, tensors)
        if stays is not None and is_matrix and stays(name):
            tensors |= of_layer(name, packed.view(state["shape"][0], -1), scales, _DTYPES[state["dtype"]])
        else:
            tensors[name] = _decoded(packed, scales, state)
    return len(names)


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
    allowed: Mapping[str, Any] = {"quant_type": ["nf4"], "dtype": [*_DTYPES], "blocksize": NF4_BLOCK_SIZES}
    if "nested_offset" in state:
        allowed = {**allowed, "nested_dtype": ["float32"], "nested_blocksize": NF4_BLOCK_SIZES}
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
    codes = part(".quant_map", torch.float32, len(NF4_CODES))
    if not torch.allclose(codes, torch.tensor(NF4_CODES), rtol=0, atol=1e-6):
        raise _misfit(f"{name}.quant_map", "the codes of NF4", shown(codes.tolist()))
    if "nested_offset" in state:
        scale_codes = part(".nested_quant_map", torch.float32, 256)
        outer = part(".nested_absmax", torch.float32, math.ceil(blocks / state["nested_blocksize"]))
        outer = outer.repeat_interleave(state["nested_blocksize"])[:blocks]
        scales = scale_codes[part(".absmax", torch.uint8, blocks).int()] * outer + state["nested_offset"]
    else:
        scales = part(".absmax", torch.float32, blocks)
    return part("", torch.uint8, (count + 1) // VALUES_PER_BYTE), scales


def _decoded(packed: Tensor, scales: Tensor, state: Mapping[str, Any]) -> Tensor:
    """Return a weight's values, from its bytes and scales."""
    count, size, blocks = math.prod(state["shape"]), state["blocksize"], len(scales)
    packed = pad(packed, (0, (blocks * size - count) // VALUES_PER_BYTE))
    codes = torch.tensor(NF4_CODES)
    pairs = torch.cartesian_prod(codes, codes)  # each byte's two values, the higher bits first
    whole = torch.empty(blocks, size, dtype=_DTYPES[state["dtype"]])
    step = _VALUES_AT_ONCE // size
    for start in range(0, blocks, step):
        some = packed[start * size // 2 : (start + step) * size // 2].int()
        whole[start : start + step] = pairs.index_select(0, some).view(-1, size) * scales[start : start + step, None]
    return whole.flatten()[:count].view(state["shape"])


def _misfit(name: str, expected: str, got: str) -> CheckpointError:
    remedy = "copy this checkpoint again, or export the full checkpoint that was rounded to NF4"
    return CheckpointError.at(name, expected, got, remedy)


_NF4: Weights = "nf4"
_BACKBONE = "model."  # prefix of the backbone's weights


def read_unrounded_config(backbone: dict[str, Any], file: Path) -> bool:
    """Return True if the configuration says that weights are in NF4, and remove this entry.

    Raises CheckpointError for weights that are rounded in another way.
    """
    is_nf4 = quantization(backbone) == NF4
    if is_nf4:
        del backbone["quantization_config"]
    check_not_quantized(backbone, file, UNQUANTIZED)
    return is_nf4


def read_published(folder: Path, is_nf4: bool, model_type: str | None = None) -> tuple[dict[str, Tensor], int]:
    """Return a folder's tensors, and how many weights are in NF4. Layers stay in NF4, other weights are decoded.

    is_nf4: True if config.json says that some are in NF4
    model_type: as in ``read_weights``
    Raises CheckpointError.
    """
    tensors = read_weights(folder, model_type)
    num_nf4 = dequantize(tensors, may_be_rounded)
    quantized = next((name for name in tensors if QUANTIZED.search(name)), None)
    if quantized is not None:
        raise CheckpointError.at(folder, "weights in full precision", shown(quantized), UNQUANTIZED)
    if is_nf4 and not num_nf4:
        got = "none; if they are meant in full precision, remove it"
        raise CheckpointError.at(f"{folder / NETWORK_CONFIG}: quantization_config", "weights in NF4", got)
    return tensors, num_nf4


def kind_of(weights: Mapping[str, Tensor]) -> Weights | None:
    """Return the format in which weights were published: NF4, or None."""
    return _NF4 if any(name.endswith(DECODED) for name in weights) else None


def rounded_as_asked(checkpoint: Checkpoint, kind: Weights | None) -> Checkpoint:
    """Return the checkpoint, with the backbone's layers rounded if the user asks for it. Raises CheckpointError.

    LoRA factors of these layers are added before rounding.
    kind: the user's option; None, another network, or layers that are already rounded: nothing changes
    """
    if kind is None or not isinstance(checkpoint, QwenCheckpoint) or checkpoint.config.weights is not None:
        return checkpoint
    factors = {**checkpoint.parts.get(LORA, {})}
    whole: dict[str, Tensor] = {}
    for name, weight in checkpoint.weights.items():
        is_layer = name.startswith(_BACKBONE) and may_be_rounded(name)
        if not (is_layer and weight.ndim == 2 and weight.shape[1] % 2 == 0):
            whole[name] = weight
            continue
        own = {factor: factors.pop(factor) for factor in [*factors] if changed_by(factor) == name}
        matrix = merged({name: weight}, own, torch.float32)[name]
        whole |= rounded(name, matrix, kind, checkpoint.config.torch_dtype)
    left: dict[str, Any] = {"factors": factors} if LORA in checkpoint.parts else {}
    changed = replace(checkpoint, config=replace(checkpoint.config, weights=kind), weights=whole, **left)
    changed.check()
    if "collator" in vars(checkpoint):  # cached: the processor is read once
        vars(changed)["collator"] = checkpoint.collator
    return changed
