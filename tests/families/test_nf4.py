# SPDX-License-Identifier: MIT
"""Weights in bitsandbytes' NF4: the same values, or a refusal."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

import goldens
from few_bits import as_bytes, case, change_config, in_both_forms
from rfm import published
from rfm.files import CheckpointError
from rfm.published import nf4
from vlm import PLAIN, load

CASES = ("nested", "plain", "float32", "blocks_across_rows", "odd")
STATE = "weight.quant_state.bitsandbytes__nf4"


@pytest.mark.parametrize("name", CASES)
def test_values_are_bitsandbytes_own(name: str) -> None:
    tensors = case(name)
    expected = tensors.pop("expected")
    assert nf4.dequantize(tensors) == 1
    assert tensors.keys() == {"weight"}
    assert tensors["weight"].dtype == expected.dtype
    assert torch.equal(tensors["weight"], expected)


def test_a_weight_of_millions_of_values_is_read_whole() -> None:
    """The same blocks again and again, more than are read at once."""
    tensors = case("plain")
    expected = tensors.pop("expected").flatten()
    times = 5_000_000 // len(expected)
    for part in ("weight", "weight.absmax"):
        tensors[part] = tensors[part].repeat(times, *[1] * (tensors[part].ndim - 1))
    stating(shape=[times, len(expected)])(tensors)
    assert nf4.dequantize(tensors) == 1
    assert torch.equal(tensors["weight"], expected.repeat(times, 1))


def stating(**changes: object) -> Callable[[dict[str, Tensor]], object]:
    """Changes the quant state; None takes the key out."""

    def spoil(tensors: dict[str, Tensor]) -> None:
        state = json.loads(tensors[STATE].numpy().tobytes()) | changes
        told = {key: value for key, value in state.items() if value is not None}
        tensors[STATE] = as_bytes(json.dumps(told).encode())

    return spoil


SPOILED: dict[str, tuple[Callable[[dict[str, Tensor]], object], str]] = {
    "no scales": (lambda t: t.pop("weight.absmax"), r"weight\.absmax: expected 257 numbers of torch\.uint8, got none; copy this checkpoint again, or export the full checkpoint that was rounded to NF4$"),
    "a scale too few": (lambda t: t.update({"weight.absmax": t["weight.absmax"][1:]}), r"weight\.absmax: expected 257 numbers of torch\.uint8, got 256 of"),
    "no codes": (lambda t: t.pop("weight.quant_map"), r"weight\.quant_map: expected 16 numbers"),
    "codes of another type": (lambda t: t["weight.quant_map"].mul_(0.5), r"weight\.quant_map: expected the codes of NF4, got \[-0\.5"),
    "no scales of scales": (lambda t: t.pop("weight.nested_absmax"), r"weight\.nested_absmax: expected 2 numbers of torch\.float32, got none"),
    "no weight": (lambda t: t.pop("weight"), r"^weight: expected 4112 numbers of torch\.uint8, got none"),
    "no JSON": (lambda t: t.update({STATE: as_bytes(b"{")}), r"^weight: expected quant_state.* in JSON, got "),
    "a huge state": (lambda t: t.update({STATE: as_bytes(b" " * 100_000)}), r"expected quant_state.* in JSON, got \[100000\] of torch\.uint8"),
    "no shape": (stating(shape=None), r"expected the shape of the weight in its quant_state, got None"),
    "another type of 4 bits": (stating(quant_type="fp4"), r"expected quant_type nf4 in its quant_state, got 'fp4'"),
    "a block of no size": (stating(blocksize=0), r"expected blocksize 32 or 64 or .* in its quant_state, got 0"),
    "blocks of another size": (stating(blocksize=64), r"weight\.nested_absmax: expected 1 numbers of torch\.float32, got 2 of"),
    "a type that is none": (stating(dtype="int8"), r"expected dtype bfloat16 or float16 or float32 in its quant_state, got 'int8'"),
    "an offset in words": (stating(nested_offset="none"), r"expected a number as nested_offset of its quant_state, got 'none'"),
    "scales of another type of number": (stating(nested_dtype="float16"), r"expected nested_dtype float32 in its quant_state, got 'float16'"),
    "scales without blocks": (stating(nested_blocksize=None), r"expected nested_blocksize 32 or .*, got None"),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "expected"), SPOILED.values(), ids=SPOILED)
def test_parts_that_do_not_fit_are_refused(spoil: Callable[[dict[str, Tensor]], object], expected: str) -> None:
    tensors = case("nested")
    spoil(tensors)
    with pytest.raises(CheckpointError, match=expected):
        nf4.dequantize(tensors)


@pytest.fixture
def both(tmp_path: Path) -> tuple[Path, Path]:
    return in_both_forms(PLAIN, tmp_path)


@pytest.mark.parametrize("kind", ["fp4", "int8"])
def test_other_types_of_bitsandbytes_are_refused_by_name(both: tuple[Path, Path], kind: str) -> None:
    change_config(both[0], kind)
    with pytest.raises(CheckpointError, match=f"quantization_config: expected none, got 'bitsandbytes {kind}'; export"):
        load(PLAIN, both[0])


def test_config_json_may_say_nothing_of_nf4_but_nothing_wrong(both: tuple[Path, Path]) -> None:
    """A trainer that saves weights alone keeps the base model's configuration."""
    few_bits, full = both
    shutil.copyfile(full / "config.json", few_bits / "config.json")
    sources = goldens.config(PLAIN).sources
    for folder, is_assumed in ((few_bits, True), (full, False)):
        assumed = [each.name for each in published.read(folder, **sources).assumptions]
        assert ("rounded_weights" in assumed) == is_assumed
    change_config(full, "nf4")
    expected = (
        r"config\.json: quantization_config: expected weights in NF4, got none; if they are meant in full precision"
    )
    with pytest.raises(CheckpointError, match=expected):
        load(PLAIN, full)
