# SPDX-License-Identifier: MIT
"""Labels in the HDF5 file of a dataset: of one provenance, whatever was there, and whoever is killed."""

from __future__ import annotations

import json
import shutil
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
from rfm_client.data.orientation import Orient
from rfm_client.labelling import DatasetError, LabelOptions, Watch, label, open_dataset

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
        assert sorted(attributes) == [
            *("problem_info", "rfm_b_episodes", "rfm_b_provenance", "rfm_episodes", "rfm_provenance"),
        ]
        assert attributes["rfm_b_provenance"] == others
        assert json.loads(attributes["rfm_provenance"])["checkpoint"]["weights_digest"] == "without success"
        dark = 1 - brightness(frames_of(1, "front"))
        np.testing.assert_allclose(opened["data/demo_1/rfm_progress"], dark, atol=1e-6)


IN_ANOTHER_PROCESS = f"""
import os, resource, sys
sys.path.insert(0, {str(Path(labelling.__file__).parent)!r})
from labelling import BrightnessScorer
from rfm_client.labelling import LabelOptions, label, open_dataset
from rfm_client.labelling.finished_episodes import Parts

read, left = Parts.read, [2]  # the first is read to see its columns

def end(self, item):
    left[0] -= 1
    return read(self, item) if left[0] >= 0 else os._exit(9)

def fill(self, item):
    size = os.path.getsize(sys.argv[1])
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + int(sys.argv[2]), resource.RLIM_INFINITY))
    return read(self, item)

Parts.read = end if sys.argv[2] == "end" else fill
label(open_dataset(sys.argv[1]), BrightnessScorer(), LabelOptions(in_place=True, overwrite=True))
"""


def label_in_another_process(file: Path, what: object) -> subprocess.CompletedProcess[str]:
    """Labels in place in a process that ends in the middle, as if it were killed, or may write so many bytes more."""
    words = [sys.executable, "-c", IN_ANOTHER_PROCESS, str(file), str(what)]
    return subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize("what", ["end", -4000, 500])
def test_in_place_the_file_is_whole_whoever_is_killed_and_whatever_is_full(demos: Path, what: object) -> None:
    label(open_dataset(demos), WithoutSuccess(), LabelOptions(in_place=True))
    before = demos.read_bytes()
    done = label_in_another_process(demos, what)
    assert demos.read_bytes() == before
    if what == "end":
        assert done.returncode == 9, done.stderr
    else:
        assert done.returncode == 1, done.stderr
        assert "make room, or leave --in-place away" in done.stderr.strip().splitlines()[-1]
        assert [file.name for file in demos.parent.iterdir() if "demos" in file.name] == ["demos.hdf5"]
    label(open_dataset(demos), BrightnessScorer(), LabelOptions(in_place=True, overwrite=True))
    assert set(map(len, rewards_in(demos).values())) == {len(COLUMNS)}


def test_in_place_needs_room_for_a_copy_before_a_frame_is_scored(demos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = demos.stat().st_size + 100
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(2 * free, free, free))  # type: ignore[attr-defined]
    scorer = BrightnessScorer()
    with pytest.raises(
        DatasetError, match=rf"demos\.hdf5: expected \d+ bytes of free disk.*, got {free}: make room, or"
    ):
        label(open_dataset(demos), scorer, LabelOptions(in_place=True))
    assert scorer.num_samples == 0
    label(open_dataset(demos), scorer, LabelOptions())


def test_in_place_a_link_stays_one_and_the_permissions_are_kept(demos: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    demos.chmod(0o640)
    real = demos.rename(tmp_path / "elsewhere" / "real.hdf5")
    demos.symlink_to(real)
    label(open_dataset(demos), BrightnessScorer(), LabelOptions(in_place=True))
    assert demos.is_symlink()
    assert real.stat().st_mode & 0o777 == 0o640
    assert set(map(len, rewards_in(real).values())) == {len(COLUMNS)}


def test_labels_that_an_older_version_did_not_write_to_the_end_are_of_another_run(demos: Path) -> None:
    with h5py.File(demos, "r+") as opened:
        opened["data/demo_1/rfm_progress"] = np.zeros(LENGTHS[1])
        opened["data"].attrs["rfm_unfinished"] = "0" * 32
    with pytest.raises(
        DatasetError, match=r"got labels of a run that did not end: choose another --name, or --overwrite"
    ):
        label(open_dataset(demos), BrightnessScorer(), LabelOptions(in_place=True))
    label(open_dataset(demos), BrightnessScorer(), LabelOptions(in_place=True, overwrite=True))
    with h5py.File(demos) as opened:
        assert sorted(opened["data"].attrs) == ["problem_info", "rfm_episodes", "rfm_provenance"]


@pytest.mark.parametrize("column", ["rfm_progress", "rfm_success.front"])
def test_what_a_user_wrote_under_the_name_of_a_reward_is_not_replaced(demos: Path, column: str) -> None:
    with h5py.File(demos, "r+") as opened:
        opened[f"data/demo_2/{column}"] = np.zeros(3)
    with pytest.raises(DatasetError, match=r"expected no labels, or .* got labels of another program: choose another"):
        label(open_dataset(demos), BrightnessScorer(), LabelOptions(in_place=True))


class Notes(Watch):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def note(self, text: str) -> None:
        self.lines.append(text)


def test_labels_say_which_cameras_are_turned_and_which_are_left_out(demos: Path) -> None:
    with h5py.File(demos, "r+") as opened:
        for index, length in enumerate(LENGTHS):
            opened[f"data/demo_{index}/obs/tactile"] = np.zeros((length, 16, 16, 3), np.float32)
    turned, notes = open_dataset(demos, orient=Orient.parse(["wrist=rotate180"])), Notes()
    (reason,) = turned.left_out.values()
    label(turned, BrightnessScorer(), LabelOptions(), notes)
    assert f"left out: tactile: {reason}" in notes.lines
    told = [line for line in notes.lines if line.startswith("orient: ")]
    assert told == [*turned.notes, "orient: wrist rotate180 (asked for)"]
    with h5py.File(demos.with_name("demos.rfm_rewards.hdf5")) as opened:
        provenance = json.loads(opened["data"].attrs["rfm_provenance"])
    assert provenance["orientations"] == {"front": "flip-vertical", "wrist": "rotate180"}
    assert provenance["decoders"] == {"front": None, "wrist": None}

    with pytest.raises(DatasetError, match=r"got orientations\.wrist: rotate180 there, flip-vertical now: choose"):
        label(open_dataset(demos), BrightnessScorer(), LabelOptions())
    notes = Notes()
    label(turned, BrightnessScorer(), LabelOptions(cameras=("front",), name="front"), notes)
    assert not [line for line in notes.lines if "tactile" in line or "wrist" in line]
