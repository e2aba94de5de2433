# SPDX-License-Identifier: MIT
"""Check weights in memory: they must fit the network, and must be real weights."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from rfm.files import WEIGHTS, CheckpointError, listed

if TYPE_CHECKING:
    from torch import Tensor


# A rounded weight has extra tensors with these endings in place of ``.weight``. A byte of NF4 holds two values.
SCALE, DECODED, VALUES_PER_BYTE = ".scale", ".decoded", 2
_MAY_BE_ZERO = re.compile(r"(progress|preference|success|similarity)_head\.|.*\.lora_[AB]\.")  # before training


def num_values(weights: Mapping[str, Tensor]) -> dict[str, int]:
    """Return how many values each weight has. A byte of NF4 holds two; scales do not count."""
    import torch  # imported here: it takes seconds

    counted = {name: tensor for name, tensor in weights.items() if not name.endswith((SCALE, DECODED))}
    return {
        name: each.numel() * (VALUES_PER_BYTE if each.dtype is torch.uint8 else 1) for name, each in counted.items()
    }


def check_shapes(expected: Mapping[str, Tensor], got: Mapping[str, Tensor]) -> None:
    """Raise CheckpointError unless names, shapes and number kinds (floating-point or not) agree."""
    check_names(expected.keys(), got.keys())
    for name, tensor in got.items():
        if tensor.shape != expected[name].shape:
            raise CheckpointError.at(name, f"{list(expected[name].shape)}", list(tensor.shape))
        if tensor.is_floating_point() != expected[name].is_floating_point():
            raise CheckpointError.at(name, f"numbers like {expected[name].dtype}", tensor.dtype)


def check_values(weights: Mapping[str, Tensor]) -> None:
    """Raise CheckpointError for a weight that is not finite, or an all-zero matrix outside the reward heads.

    Such weights may still give finite scores, such as a success of 1. An unfinished download leaves zeros.
    """
    for name, tensor in weights.items():
        if not (tensor.is_floating_point() and tensor.numel()):
            continue
        extremes = tensor.aminmax()  # 50 times as fast as isfinite on each value
        if not all(extreme.isfinite() for extreme in extremes):
            at = (~tensor.isfinite()).nonzero()[0].tolist()
            raise CheckpointError.at(name, "finite weights", f"{tensor[tuple(at)].item()} at {at}")
        is_matrix = tensor.dim() > 1 and min(tensor.shape) > 1
        if is_matrix and not any(extremes) and not _MAY_BE_ZERO.match(name):
            raise CheckpointError.at(name, "weights", "0 throughout: the file is incomplete", "fetch or copy it again")


def check_names(expected: Iterable[str], got: Iterable[str]) -> None:
    """Raise CheckpointError unless the weight names agree."""
    missing, unexpected = sorted(set(expected) - set(got)), sorted(set(got) - set(expected))
    if missing or unexpected:
        named = [listed(names) if names else "none" for names in (missing, unexpected)]
        raise CheckpointError(f"{WEIGHTS}: missing keys: {named[0]}; unexpected keys: {named[1]}")
