# SPDX-License-Identifier: MIT
"""Weights in NF4 as bitsandbytes writes them, and reference checkpoints with such weights."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

import goldens
from paths import GOLDEN
from spoilt import copied, settings
from vlm import PLAIN

WEIGHTS = GOLDEN / "nf4" / "weights.safetensors"
LORA_INSIDE = "q3_lora_full_disc10"

# For NF4 layers beside the values in full size. LoRA factors stay beside NF4, as in PEFT, and sum in another order
# than merged ones.
TOLERANCES = {PLAIN: 1e-6, LORA_INSIDE: goldens.LORA_TOLERANCES[1]}


def case(name: str) -> dict[str, Tensor]:
    return {
        key.removeprefix(f"{name}."): tensor for key, tensor in load_file(WEIGHTS).items() if key.startswith(f"{name}.")
    }


def as_bytes(text: bytes) -> Tensor:
    return torch.frombuffer(bytearray(text), dtype=torch.uint8)


def rounded(name: str, weight: Tensor) -> tuple[dict[str, Tensor], Tensor]:
    """Return a weight's parts in NF4, and the values."""
    codes, blocksize = case("plain")["weight.quant_map"], 64
    blocks = torch.nn.functional.pad(weight.float().flatten(), (0, -weight.numel() % blocksize)).view(-1, blocksize)
    scales = blocks.abs().amax(1)
    nearest = (blocks[..., None] / scales.clamp(min=1e-30)[:, None, None] - codes).abs().argmin(-1)
    values = (codes[nearest] * scales[:, None]).flatten()[: weight.numel()].view(weight.shape).bfloat16()
    packed = (nearest.flatten()[0::2] * 16 + nearest.flatten()[1::2]).byte()[: (weight.numel() + 1) // 2, None]
    state = {"quant_type": "nf4", "blocksize": blocksize, "dtype": "bfloat16", "shape": [*weight.shape]}
    parts = {"": packed, ".absmax": scales, ".quant_map": codes.clone()}
    parts[".quant_state.bitsandbytes__nf4"] = as_bytes(json.dumps(state).encode())
    return {name + part: tensor.contiguous() for part, tensor in parts.items()}, values


def in_both_forms(name: str, folder: Path) -> tuple[Path, Path]:
    """A reference checkpoint with linear weights in NF4, and the same with the NF4 values in full size."""
    few_bits: dict[str, Tensor] = {}
    full: dict[str, Tensor] = {}
    for key, tensor in load_file(goldens.config(name).checkpoint / "model.safetensors").items():
        few_bits[key] = full[key] = tensor
        if tensor.ndim == 2 and not any(part in key for part in ("embed", "lora_", "norm")):
            few_bits.pop(key)
            parts, full[key] = rounded(key, tensor)
            few_bits |= parts
    places = folder / "nf4", folder / "full"
    for place, tensors in zip(places, (few_bits, full), strict=True):
        save_file(tensors, copied(goldens.config(name), place) / "model.safetensors", {"format": "pt"})
    change_config(places[0], "nf4")
    return places


def change_config(folder: Path, kind: str) -> None:
    """Names the quantization in config.json as transformers does for bitsandbytes."""
    is_int8 = kind == "int8"
    quantization = {
        "quant_method": "bitsandbytes",
        "load_in_4bit": not is_int8,
        "load_in_8bit": is_int8,
        "bnb_4bit_quant_type": "fp4" if is_int8 else kind,
        "bnb_4bit_compute_dtype": "bfloat16",
        "bnb_4bit_use_double_quant": False,
    }
    settings("config.json", quantization_config=quantization)(folder)
