# SPDX-License-Identifier: MIT
"""config.yaml from the training run: where it lies, and how the run trained the heads, which no score shows."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rfm.files import (
    ADAPTER_CONFIG,
    NETWORK_CONFIG,
    RUN_CONFIG,
    RUN_CONFIGS,
    WEIGHTS,
    CheckpointError,
    is_there,
    read_json,
    read_run_config,
    shown,
)
from rfm.published.provenance import snapshot_of

if TYPE_CHECKING:
    from torch import Tensor


PROGRESS, PREFERENCE, SUCCESS, SIMILARITY = HEADS = ("progress", "preference", "success", "similarity")
FROM_FIRST_FRAME = "absolute_first_frame"  # a value for data.progress_pred_type
MAX_COUNT = 2**20  # frames; longer than any trajectory
_COMMIT_DIGITS = 40


def find_run_config(folder: Path) -> Path | None:
    """Return the run's configuration file: in the checkpoint's folder, its parent, or these on main in the Hub's cache.

    Raises CheckpointError if a file outside the folder belongs to another network type.
    """
    home = folder.resolve()
    for place in (folder, home.parent, *_places_on_main(home)):
        file = next((place / name for name in RUN_CONFIGS if is_there(place / name)), None)
        if file is not None:
            if place != folder:
                _check_base(file, folder)
            return file
    return None


def _check_base(file: Path, folder: Path) -> None:
    def plain(name: str) -> str:
        return re.sub(r"[^a-z0-9]", "", name.lower())

    base = section_of(read_run_config(file), "model").get("base_model_id")
    if is_there(folder / NETWORK_CONFIG):
        kind = read_json(folder / NETWORK_CONFIG).get("model_type")
    else:  # an adapter names its base model; the first ReWiND checkpoints have no config.json
        kind = None if is_there(folder / ADAPTER_CONFIG) else "rewind_transformer"
    if isinstance(kind, str) and isinstance(base, str) and base and plain(kind) not in plain(base):
        expected = f"the run of {folder}, whose network is {shown(kind)}"
        remedy = f"copy the run's {RUN_CONFIG} into {folder}, also if it is this one"
        raise CheckpointError.at(file, expected, f"model.base_model_id {shown(base)}", remedy)


def _places_on_main(home: Path) -> list[Path]:
    """Return ``home`` (and its parent, for a subfolder) in main's snapshot in the Hub's cache."""
    snapshot = snapshot_of(home)
    if snapshot is None or not is_there(main := snapshot.parent.parent / "refs" / "main"):
        return []
    with main.open("rb") as file:
        commit = file.read(_COMMIT_DIGITS + 1)
    if not re.fullmatch(rb"[0-9a-f]+", commit):
        return []
    place = snapshot.parent / commit.decode() / home.relative_to(snapshot)
    return [place] if home == snapshot else [place, place.parent]


def section_of(run: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Return a section from the configuration; empty if it is no mapping, which the family refuses."""
    section = run.get(name)
    return section if isinstance(section, dict) else {}


def trained_frames(run: Mapping[str, Any], file: Path) -> int | None:
    """Return data.max_frames from config.yaml, the frame count of the longest trajectory in training, or None.

    Raises CheckpointError.
    """
    data = run.get("data") or {}
    if not isinstance(data, dict):
        raise CheckpointError.at(f"{file}: data", "a mapping", shown(data))
    return frame_count(data.get("max_frames"), f"{file}: data.max_frames")


def frame_count(frames: Any, where: str) -> int | None:
    """Return ``frames`` if it is None or a valid frame count. Raises CheckpointError otherwise."""
    if frames is not None and (type(frames) is not int or frames < 1):
        raise CheckpointError.at(where, "a whole number of at least 1", shown(frames))
    if frames is not None and frames > MAX_COUNT:
        raise CheckpointError.at(where, f"at most {MAX_COUNT}", shown(frames))
    return frames


def check_progress(run: Mapping[str, Any], file: Path) -> None:
    """Raise CheckpointError for a head that was trained on progress increments.

    run: config.yaml, read from ``file``
    """
    kind = section_of(run, "data").get("progress_pred_type")
    if isinstance(kind, str) and kind.startswith("relative"):  # upstream's names for increments
        got = (
            f"{shown(kind)}: such a head predicts how far the task has come since the frame before, which would be "
            "served as how far it has come"
        )
        raise CheckpointError.at(f"{file}: data.progress_pred_type", "absolute progress", got)


def training_notes(folder: Path, answered: Collection[str]) -> list[str]:
    """Return one line for the user per training run setting that makes scores doubtful.

    answered: heads that the model serves; an earlier run may have trained them
    Raises CheckpointError for a config.yaml that cannot be read.
    """
    file = find_run_config(folder)
    run = {} if file is None else read_run_config(file)
    model, data = section_of(run, "model"), section_of(run, "data")
    lines = [
        f"{RUN_CONFIG}: model.train_{head}_head is false: the run did not train the head of {head}, so {head} means "
        "something only if the run started from a checkpoint that did"
        for head in HEADS
        if head in answered and model.get(f"train_{head}_head") is False
    ]
    if PROGRESS in answered and section_of(run, "loss").get("predict_last_frame_progress") is True:
        lines.append(
            f"{RUN_CONFIG}: loss.predict_last_frame_progress is true: the run trained progress of the last frame "
            "alone, so progress of the frames before it means something only if the run started from a checkpoint "
            "that trained it"
        )
    if PROGRESS in answered and data.get("progress_pred_type") == FROM_FIRST_FRAME:
        lines.append(
            f"{RUN_CONFIG}: data.progress_pred_type is {FROM_FIRST_FRAME}: progress is 0 at the first frame that the "
            "model is shown, and 1 at the end of the task; show each episode from its beginning, and do not compare "
            "parts of an episode that begin at different frames"
        )
    if PROGRESS in answered and data.get("shuffle_progress_frames") is True:
        lines.append(
            f"{RUN_CONFIG}: data.shuffle_progress_frames is true: the run shuffled all frames but the first, so "
            "progress of a frame does not follow from the order of the frames, which are shown in order here"
        )
    if model.get("quantization") is True:
        lines.append(
            f"{RUN_CONFIG}: model.quantization is true: the run scored with its base model rounded to a few bits; the "
            "scores here are those of the weights as they stand, so they differ from the run's unless these are "
            "rounded alike"
        )
    return lines


# Keys in a config.json of LeRobot's reward models about LeRobot's own pipelines and uploads.
_LEROBOT_IDLE = {
    "default_task", "device", "image_key", "input_features", "license", "normalization_mapping", "output_features",
    "pretrained_path", "pretrained_revision", "private", "push_to_hub", "repo_id", "success_threshold", "tags",
    "task_key", "type",
}  # fmt: skip


def check_lerobot(content: Mapping[str, Any], file: Path, needed: Collection[str], known: Collection[str]) -> None:
    """Raise CheckpointError for a key in LeRobot's config.json that is missing, null or unknown.

    needed, known: keys that must have a value, and keys that may be there
    """
    if unknown := sorted(content.keys() - _LEROBOT_IDLE - {*needed, *known}):
        expected = f"the keys of LeRobot's {content['type']}"
        raise CheckpointError.at(file, expected, shown(unknown[0]), "if it changes no score, remove it")
    if missing := [key for key in needed if content.get(key) is None]:
        raise CheckpointError.at(f"{file}: {missing[0]}", "a value", "none", "save the model with LeRobot again")


def constant_heads(weights: Mapping[str, Tensor], answered: Collection[str]) -> list[str]:
    """Return one line for the user per head in ``answered`` whose last weight is 0 throughout, as if untrained."""
    heads = {head: weights.get(f"{head}_head.4.weight") for head in answered}
    return [
        f"{WEIGHTS}: {head}_head.4.weight is 0 throughout: {head} is the same whatever is scored, as if untrained"
        for head, weight in heads.items()
        if weight is not None and not weight.any()
    ]
