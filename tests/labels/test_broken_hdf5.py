# SPDX-License-Identifier: MIT
"""HDF5 files with dead links, odd attributes and names, or damage: a line or an error names each fault."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from labelling import BrightnessScorer, Notes
from rfm_client import RewardError
from rfm_labels import DatasetError, LabelOptions, label, open_dataset

TASK = "open the drawer"
LENGTH = 5


@pytest.fixture
def demos(tmp_path: Path) -> Path:
    """Three demonstrations as robomimic writes them."""
    file = tmp_path / "demos.hdf5"
    with h5py.File(file, "w") as opened:
        for index in range(3):
            demo = opened.create_group(f"data/demo_{index}")
            demo.attrs["num_samples"] = LENGTH
            demo["actions"] = np.zeros((LENGTH, 7))
            demo["obs/front"] = np.random.default_rng(index).integers(0, 256, (LENGTH, 16, 16, 3), np.uint8)
        opened["data"].attrs["env_args"] = json.dumps({"env_name": "Lift", "lang": TASK})
    return file


def changed(file: Path, change: Callable[[Any], object]) -> Path:
    with h5py.File(file, "r+") as opened:
        change(opened)
    return file


def put(path: str, value: Any) -> Callable[[Any], None]:
    """Replace the object at a path."""

    def change(opened: Any) -> None:
        opened.pop(path, None)
        opened[path] = value

    return change


def told(path: str, name: str, value: Any) -> Callable[[Any], None]:
    """Set an attribute of the object at a path."""

    def change(opened: Any) -> None:
        opened[path].attrs[name] = value

    return change


GONE, OUTSIDE = h5py.SoftLink("/nowhere"), h5py.ExternalLink("gone.hdf5", "/data")
PICTURES = np.zeros((LENGTH, 16, 16, 3), np.uint8)
NO_CAMERA = "data/demo_1/obs: expected a camera as uint8 [T, H, W, 3], got front: "
NOWHERE = "demo_1 has a broken link or no array"
NO_TASK = "data/demo_0: ep_meta, or data: "
REFUSED: dict[str, tuple[Callable[[Any], object], str]] = {
    "a demonstration that is no longer there": (put("data/demo_1", GONE), f"{NO_CAMERA}demo_1 is a broken link"),
    "a demonstration in a lost file": (put("data/demo_1", OUTSIDE), f"{NO_CAMERA}demo_1 is a broken link"),
    "observations that are no longer there": (put("data/demo_1/obs", GONE), f"{NO_CAMERA}missing in demo_1"),
    "a camera that is no longer there": (put("data/demo_1/obs/front", GONE), NO_CAMERA + NOWHERE),
    "a camera in a lost file": (put("data/demo_1/obs/front", OUTSIDE), NO_CAMERA + NOWHERE),
    "a camera without data": (put("data/demo_1/obs/front", h5py.Empty("u1")), NO_CAMERA + NOWHERE),
    "a camera of no pixels": (put("data/demo_1/obs/front", PICTURES[:, :0]), "uint8 [5, 0, 16, 3], no pixels"),
    "a camera of no frames": (put("data/demo_1/obs/front", PICTURES[:0]), "expected one length, above 0, got obs/fron"),
    "a link to itself": (put("data/demo_1/obs/front", h5py.SoftLink("/data/demo_1/obs/front")), "undamaged HDF5 file"),
    "data in a lost file": (
        put("data", OUTSIDE),
        "data: expected demo_0, demo_1 and so on, got none: the file holds d",
    ),
    "two demonstrations of one number": (
        lambda opened: opened["data"].copy("demo_0", "demo_00"),
        "data: expected one demonstration of each number, got demo_0 and demo_00: rename one of them",
    ),
    "two sentences in an attribute": (
        told("data/demo_0", "language", ["open", "close"]),
        "expected a task as a sentence, got ['open', 'close']",
    ),
    "an attribute that is no JSON": (
        told("data", "env_args", "{'env_name': 'Lift'}"),
        f"{NO_TASK}problem_info or env_args (no JSON object): expected a task as a sentence, got none",
    ),
    "an attribute of numbers": (told("data", "env_args", [1, 2]), "env_args (no JSON object): expected a task as a se"),
    "fewer actions than frames": (put("data/demo_1/actions", np.zeros((3, 7))), "got obs/front 5, actions 3"),
}


@pytest.mark.parametrize(("break_it", "message"), REFUSED.values(), ids=REFUSED)
def test_a_broken_file_is_refused_with_the_place(demos: Path, break_it: Callable[[Any], object], message: str) -> None:
    scorer = BrightnessScorer()
    with pytest.raises(DatasetError) as refused:
        label(open_dataset(changed(demos, break_it)), scorer)
    assert message in str(refused.value)
    assert scorer.num_samples == 0


def test_a_lost_demonstration_does_not_stop_the_others(demos: Path) -> None:
    changed(demos, put("data/demo_1", GONE))
    report = label(open_dataset(demos), BrightnessScorer(), LabelOptions(episodes=[0, 2]))
    assert [item.episode.name for item in report.plan.items] == ["demo_0", "demo_2"]


def test_all_demonstrations_without_the_most_common_camera_are_left_out_by_the_list_that_is_printed(
    tmp_path: Path,
) -> None:
    file = tmp_path / "demos.hdf5"
    with h5py.File(file, "w") as opened:
        for index in range(5):
            opened[f"data/demo_{index}/obs/front"] = PICTURES
            opened[f"data/demo_{index}/obs/wrist"] = PICTURES
        for gone in ("demo_1", "demo_3/obs/front", "demo_0/obs/wrist", "demo_2/obs/wrist", "demo_4/obs/wrist"):
            del opened[f"data/{gone}"]
        opened["data/demo_1"] = GONE
    with pytest.raises(DatasetError) as refused:
        label(open_dataset(file, task="stack the cups"), BrightnessScorer())
    form, nowhere = "expected a camera as uint8 [T, H, W, 3], got ", "demo_1 is a broken link"
    assert str(refused.value).splitlines() == [
        "episodes: expected 5 that can be labelled, got 2 with faults:",
        f"{file}: data/demo_1/obs: {form}front: {nowhere}; wrist: {nowhere}",
        f"{file}: data/demo_3/obs: {form}front: missing in demo_3",
        "to continue without the faulty episodes: --episodes 0,2,4",
    ]
    label(open_dataset(file, task="stack the cups"), BrightnessScorer(), LabelOptions(episodes=[0, 2, 4]))


def others(opened: Any) -> None:
    for name in ("data/demo_a/obs", "data/demo_0_rollout/obs", "rollouts/demo_0/obs"):
        opened.create_group(name)


def masks(opened: Any) -> None:
    opened["mask/train"] = np.array(["demo_0", "demo_2"], "S8")
    opened["mask/numbers"] = np.arange(2)
    opened["mask/others"] = np.array(["demo_0", "demo_00"], "S8")
    opened["mask/lost"] = GONE


def without_last_action(opened: Any) -> None:
    for demo in opened["data"].values():
        del demo["actions"]
        demo["actions"] = np.zeros((LENGTH - 1, 7))


TOLD: dict[str, tuple[Callable[[Any], object], list[str]]] = {
    "groups with other names": (
        others,
        ["left out: data/demo_0_rollout, data/demo_a, rollouts: demonstrations are data/demo_<number>"],
    ),
    "filter keys of others": (
        masks,
        [
            "left out: mask/lost: expected names of demonstrations, got no text",
            "left out: mask/numbers: expected names of demonstrations, got 0, 1",
            "left out: mask/others: expected names of demonstrations, got demo_00",
        ],
    ),
    "an observation after the last action": (
        without_last_action,
        ["lengths: demo_0, demo_1, demo_2: one observation more than actions: each observation gets a label"],
    ),
    "another number of samples": (
        told("data/demo_1", "num_samples", 7),
        ["lengths: num_samples differs: demo_1 (7, has 5): each observation gets a label"],
    ),
    "a picture that is no longer there": (
        lambda opened: [put(f"data/demo_{index}/obs/wrist", GONE)(opened) for index in range(3)],
        ["left out: wrist: demo_0 has a broken link or no array"],
    ),
    "observations in a circle": (
        put("data/demo_0/obs/all", h5py.SoftLink("/data/demo_0/obs")),
        ["left out: all: a group: expected its pictures one level up"],
    ),
    "an attribute that is no JSON": (
        told("data", "problem_info", b"libero"),
        ["data: problem_info is not a JSON object, so it states neither a task nor LIBERO"],
    ),
    "one sentence in an array": (told("data/demo_0", "language", np.array(["close it"], object)), []),
    "no text": (told("data/demo_0", "language", h5py.Empty("S4")), []),
    "numbers of another form": (put("data/demo_0/obs/point", np.zeros(LENGTH, [("x", "f4"), ("y", "f4")])), []),
    "actions that are no array": (put("data/demo_0/actions", GONE), []),
    "a type": (put("data/demo_0/obs/kind", np.dtype("f4")), [f"left out: kind: {NOWHERE.replace('1', '0')}"]),
}


@pytest.mark.parametrize(("change", "lines"), TOLD.values(), ids=TOLD)
def test_what_is_left_out_or_differs_is_told_and_the_rest_is_labelled(
    demos: Path, change: Callable[[Any], object], lines: list[str]
) -> None:
    notes = Notes()
    report = label(open_dataset(changed(demos, change)), BrightnessScorer(), LabelOptions(), notes)
    assert report.summary is not None
    assert report.summary.num_frames == 3 * LENGTH
    settings = ("cameras:", "sampling:", "frames:", "orient:")
    assert [line for line in notes.lines if not line.startswith(settings)] == lines


@pytest.mark.parametrize("seed", range(2))
def test_a_damaged_file_is_read_or_refused(demos: Path, seed: int) -> None:
    whole, draw = demos.read_bytes(), random.Random(seed)
    for number in range(15):
        damaged = bytearray(whole)
        for _ in range(draw.choice((1, 4, 16))):
            damaged[draw.randrange(len(whole))] = draw.randrange(256)
        demos.write_bytes(damaged)
        try:
            options = LabelOptions(overwrite=True, parts=str(demos.with_name(f"{number}")))
            label(open_dataset(demos, task=TASK), BrightnessScorer(), options)
        except (RewardError, OSError):
            pass
