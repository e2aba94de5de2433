# SPDX-License-Identifier: MIT
"""Cameras with black frames or without colours: warnings, and the cameras that labelling leaves out."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_commands import invoke
from hdf5_writers import write_robomimic
from labelling import FRONT, LEROBOT, WRIST, BrightnessScorer, Notes
from rfm_labels import DatasetError, LabelOptions, label, open_dataset
from rfm_labels.datasets.dataset import word_of_no_colours

TASK = "stack the cups"
ADVICE = "its scores mean nothing there; leave out the camera (--cameras) or the episodes (--episodes)"


def noise(count: int = 12) -> np.ndarray[Any, Any]:
    return np.random.default_rng(count).integers(0, 256, (count, 16, 16, 3), np.uint8)


def black(count: int = 12) -> np.ndarray[Any, Any]:
    return np.zeros((count, 16, 16, 3), np.uint8)


def lines_of(source: Path, output: Path, **options: Any) -> list[str]:
    """Return a run's lines about blank pictures."""
    notes = Notes()
    dataset = open_dataset(source, task=TASK, override_task=True)
    label(dataset, BrightnessScorer(), LabelOptions(output=output, frames=2, **options), notes)
    return [line for line in notes.lines if "pictures" in line]


def of_hdf5(folder: Path) -> Path:
    shown = [{"front": noise(), "video": black() if index in (0, 2) else noise()} for index in range(3)]
    return write_robomimic(folder / "demos.hdf5", shown, None)


def test_many_episodes_are_abbreviated(tmp_path: Path) -> None:
    shown = [{"front": noise(3) if index % 2 else black(3)} for index in range(40)]
    (told,) = lines_of(write_robomimic(tmp_path / "demos.hdf5", shown, None), tmp_path / "labels")
    assert "in 20 of 40 episodes (0,2,4,6,8,10,12,14,16,18,20,22,...): " in told


def test_each_run_and_a_report_list_the_episodes_in_which_a_camera_shows_nothing(tmp_path: Path) -> None:
    file, output = of_hdf5(tmp_path), tmp_path / "labels"
    line = f"video: black pictures, in 2 of 3 episodes (0,2): {ADVICE}"
    assert lines_of(file, output) == [line]
    assert lines_of(file, output) == [line]  # of parts that are there
    result = invoke("label", file, "--report", "--output", output)
    assert (result.exit_code, f"note: {line}" in result.stderr) == (0, True)


NO_COLOURS = ("agentview_depth", "depth_head", "seg_instance_id", "topDepth", "depth2", "optical-flow", "normals.0")
COLOURS = ("deep_camera", "segway", "masked_rgb", "overflow", "abnormal")


def test_words_in_names_mark_cameras_without_colours(tmp_path: Path) -> None:
    assert [camera for camera in (*NO_COLOURS, *COLOURS) if word_of_no_colours(camera)] == list(NO_COLOURS)
    file, notes = write_robomimic(tmp_path / "demos.hdf5", [{"front": noise(), "depth_head": noise()}], None), Notes()
    dataset = open_dataset(file, task=TASK)
    report = label(dataset, BrightnessScorer(), LabelOptions(output=tmp_path / "labels", frames=2), notes)
    assert report.plan.recipe.cameras == ("front",)
    (told,) = [line for line in notes.lines if line.startswith("left out: depth_head: ")]
    assert told.endswith("by name or mark, without colours; --cameras includes it")
    assert dataset.chosen_cameras(["depth_head"]) == ("depth_head",)


def renamed(folder: Path, *cameras: tuple[str, str, str]) -> Path:
    """A LeRobot dataset whose cameras have other names. cameras: key, new key and dtype"""
    root = Path(shutil.copytree(LEROBOT / "toy_v21", folder / "toy"))
    file = root / "meta" / "info.json"
    info = json.loads(file.read_text())
    for key, new, dtype in cameras:
        info["features"][new] = {**info["features"].pop(key), "dtype": dtype}
    file.write_text(json.dumps(info))
    return root


def test_words_in_names_count_for_lerobot_and_a_dataset_of_such_cameras_alone_needs_a_name(tmp_path: Path) -> None:
    seg, depth = "observation.images.seg", "observation.images.depth"
    dataset = open_dataset(renamed(tmp_path / "one", (WRIST, depth, "image")))
    assert (dataset.chosen_cameras(), dataset.chosen_cameras(["depth"])) == ((FRONT,), (depth,))
    root = renamed(tmp_path / "both", (FRONT, seg, "video"), (WRIST, depth, "video"))
    with pytest.raises(DatasetError) as caught:
        open_dataset(root).chosen_cameras()
    expected = f"cameras: expected some of {seg}, {depth} named: all are seg and depth cameras, got none"
    assert str(caught.value) == expected
