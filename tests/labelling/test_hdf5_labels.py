# SPDX-License-Identifier: MIT
"""Labels in the HDF5 file of a dataset: of one provenance, whatever was there, and whoever is killed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import labelling
from labelling import BrightnessScorer, brightness
from rfm_client import ProgressResult, ProgressSample
from rfm_client.labelling import DatasetError, LabelOptions, label, open_dataset

LENGTHS = (5, 7, 3)
CAMERAS = ("front", "wrist")


def frames_of(index: int, camera: str) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.random.default_rng([index, len(camera)]).integers(0, 256, (LENGTHS[index], 16, 16, 3), np.uint8)


def expected(index: int) -> Any:
    return np.mean([brightness(frames_of(index, camera)) for camera in CAMERAS], axis=0)


@pytest.fixture
def demos(tmp_path: Path) -> Path:
    file = tmp_path / "demos.hdf5"
    with h5py.File(file, "w") as opened:
        opened.create_group("data").attrs["problem_info"] = json.dumps({"language_instruction": "open the drawer"})
        for index, length in enumerate(LENGTHS):
            opened[f"data/demo_{index}/actions"] = np.zeros((length, 7))
            for camera in CAMERAS:
                opened[f"data/demo_{index}/obs/{camera}"] = frames_of(index, camera)
    return file


class WithoutSuccess(BrightnessScorer):
    """Another checkpoint, which predicts no success."""

    def __init__(self) -> None:
        super().__init__(digest="without success")

    def evaluate(self, samples: Sequence[ProgressSample]) -> list[ProgressResult]:
        results = super().evaluate(samples)
        return [
            ProgressResult(progress=1 - result.progress, success=np.full_like(result.progress, np.nan))
            for result in results
        ]


def rewards_in(file: Path) -> dict[str, list[str]]:
    """Names of what is in each demonstration besides what was recorded."""
    with h5py.File(file) as opened:
        return {name: sorted({*demo} - {"actions", "obs"}) for name, demo in opened["data"].items()}


COLUMNS = [f"{score}{camera}" for score in ("progress", "success") for camera in ("", ".front", ".wrist")]
ONE_OF_ANOTHER = LabelOptions(in_place=True, overwrite=True, cameras=("front",), episodes=[1])


def test_labels_that_are_overwritten_in_place_leave_none_of_another_provenance(demos: Path) -> None:
    for name in ("rfm", "rfm_b"):
        label(open_dataset(demos), BrightnessScorer(), LabelOptions(in_place=True, name=name))
    with h5py.File(demos, "r+") as opened:
        opened["data/demo_0/rfm_notes"] = "a user's own"
        others = opened["data"].attrs["rfm_b_provenance"]
    label(open_dataset(demos), WithoutSuccess(), ONE_OF_ANOTHER)
    of_others = sorted(f"rfm_b_{column}" for column in COLUMNS)
    assert rewards_in(demos) == {
        "demo_0": [*of_others, "rfm_notes"],
        "demo_1": [*of_others, "rfm_progress"],
        "demo_2": of_others,
    }
    with h5py.File(demos) as opened:
        attributes = opened["data"].attrs
        assert sorted(attributes) == ["problem_info", "rfm_b_provenance", "rfm_provenance"]
        assert attributes["rfm_b_provenance"] == others
        assert json.loads(attributes["rfm_provenance"])["checkpoint"]["weights_digest"] == "without success"
        dark = 1 - brightness(frames_of(1, "front"))
        np.testing.assert_allclose(opened["data/demo_1/rfm_progress"], dark, atol=1e-6)


def label_and_be_killed(file: Path, options: LabelOptions, *, num_parts: int) -> None:
    """Labels in a process that ends at once, as if it were killed, when it has written so many parts into the file."""
    code = f"""
import os, sys
sys.path.insert(0, {str(Path(labelling.__file__).parent)!r})
from labelling import BrightnessScorer
from rfm_client.labelling import LabelOptions, label, open_dataset
from rfm_client.labelling.finished_episodes import Parts

read, left = Parts.read, [{num_parts} + 1]  # the first is read to see its columns

def read_or_end(*arguments):
    left[0] -= 1
    return read(*arguments) if left[0] >= 0 else os._exit(9)

Parts.read = read_or_end
label(open_dataset({str(file)!r}), BrightnessScorer(digest="killed"), {options!r})
"""
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=60, check=False)
    assert process.returncode == 9, process.stderr.decode()


@pytest.mark.parametrize("num_parts", [0, 2])
def test_the_same_command_goes_on_in_place_after_a_kill(demos: Path, num_parts: int) -> None:
    label_and_be_killed(demos, LabelOptions(in_place=True), num_parts=num_parts)
    with pytest.raises(DatasetError, match=r"got labels of another run, which did not end: choose another --name"):
        label(open_dataset(demos), BrightnessScorer(), LabelOptions(in_place=True))
    label(open_dataset(demos), BrightnessScorer(digest="killed"), LabelOptions(in_place=True))
    assert set(map(len, rewards_in(demos).values())) == {len(COLUMNS)}
    with h5py.File(demos) as opened:
        assert sorted(opened["data"].attrs) == ["problem_info", "rfm_provenance"]
        np.testing.assert_allclose(opened["data/demo_2/rfm_progress"], expected(2), atol=1e-6)


def test_labels_of_two_provenances_are_never_taken_for_those_of_the_first(demos: Path) -> None:
    label(open_dataset(demos), WithoutSuccess(), LabelOptions(in_place=True))
    label_and_be_killed(demos, LabelOptions(in_place=True, overwrite=True), num_parts=1)
    with h5py.File(demos) as opened:
        assert "rfm_provenance" not in opened["data"].attrs
    with pytest.raises(DatasetError, match=r"got labels of another run, which did not end"):
        label(open_dataset(demos), WithoutSuccess(), LabelOptions(in_place=True))
    label(open_dataset(demos), BrightnessScorer(digest="killed"), LabelOptions(in_place=True))
    assert set(map(len, rewards_in(demos).values())) == {len(COLUMNS)}


@pytest.mark.parametrize("column", ["rfm_progress", "rfm_success.front"])
def test_what_a_user_wrote_under_the_name_of_a_reward_is_not_replaced(demos: Path, column: str) -> None:
    with h5py.File(demos, "r+") as opened:
        opened[f"data/demo_2/{column}"] = np.zeros(3)
    with pytest.raises(DatasetError, match=r"expected no labels rfm, or of the same provenance, got labels of another"):
        label(open_dataset(demos), BrightnessScorer(), LabelOptions(in_place=True))
