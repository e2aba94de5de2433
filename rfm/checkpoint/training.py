# SPDX-License-Identifier: MIT
"""How the heads of a checkpoint were trained: what config.yaml says of it, and weights. No score shows it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rfm.checkpoint.content import CheckpointError, read_run_config, shown
from rfm.checkpoint.files import RUN_CONFIG, WEIGHTS, find_run_config

if TYPE_CHECKING:
    from torch import Tensor

PROGRESS, PREFERENCE, SUCCESS, SIMILARITY = HEADS = ("progress", "preference", "success", "similarity")
_RELATIVE = "relative"  # how upstream's names of increments begin


def untrained_heads(run: Mapping[str, Any]) -> list[str]:
    """Those of HEADS that the run did not train. The one it started from may have: the flags prove nothing of weights.

    run: config.yaml; of a flag that it lacks nothing is known
    """
    model = _section(run, "model")
    return [head for head in HEADS if model.get(f"train_{head}_head") is False]


def notes(folder: Path, answered: Collection[str] = HEADS) -> list[str]:
    """A line for the user on each thing that the training run of the checkpoint in ``folder`` left untrained.

    answered: heads of which its answers are made
    Raises CheckpointError for a config.yaml that cannot be read.
    """
    file = find_run_config(folder)
    run = {} if file is None else read_run_config(file)
    lines = [
        f"{RUN_CONFIG}: model.train_{head}_head is false: the run did not train the head of {head}, so {head} means "
        "something only if the run started from a checkpoint that did"
        for head in untrained_heads(run)
        if head in answered
    ]
    if PROGRESS in answered and _section(run, "loss").get("predict_last_frame_progress") is True:
        lines.append(
            f"{RUN_CONFIG}: loss.predict_last_frame_progress is true: the run trained progress of the last frame "
            "alone, so progress of the frames before it means something only if the run started from a checkpoint "
            "that trained it"
        )
    if _section(run, "model").get("quantization") is True:
        lines.append(
            f"{RUN_CONFIG}: model.quantization is true: the run scored with its base model rounded to a few bits; the "
            "scores here are those of the weights as they stand, so they differ from the run's unless these are "
            "rounded alike"
        )
    return lines


def constant_heads(weights: Mapping[str, Tensor], answered: Collection[str]) -> list[str]:
    """A line for the user on each head of ``answered`` whose last layer multiplies by 0, as before any training."""
    heads = {head: weights.get(f"{head}_head.4.weight") for head in answered}
    return [
        f"{WEIGHTS}: {head}_head.4.weight is 0 throughout: {head} is the same whatever is scored, as if untrained"
        for head, weight in heads.items()
        if weight is not None and not weight.any()
    ]


def check_progress(run: Mapping[str, Any], file: Path) -> None:
    """Raises CheckpointError for a head that was trained on increments of progress, not on progress.

    run: config.yaml, read from ``file``
    """
    kind = _section(run, "data").get("progress_pred_type")
    if isinstance(kind, str) and kind.startswith(_RELATIVE):
        raise CheckpointError(
            f"{file}: data.progress_pred_type: expected absolute progress, got {shown(kind)}: such a head predicts how "
            "far the task has come since the frame before, which would be served as how far it has come"
        )


def _section(run: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """The section of that name; an empty one if it is none, which is for the family to refuse."""
    section = run.get(name)
    return section if isinstance(section, dict) else {}
