# SPDX-License-Identifier: MIT
"""HDF5 files of one episode: cameras, files of frames, colours, tasks, labels."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import hdf5_writers as writers
from hdf5_writers import RGB_MARK, TASK, decoded, jpeg, video
from labelling import BrightnessScorer
from rfm_client import UInt8Array
from rfm_labels import Dataset, DatasetError, LabelOptions, label, open_dataset

LENGTH = 6
FILES = {name: [jpeg(frame) for frame in video(LENGTH, seed)] for seed, name in enumerate(("high", "left", "right"))}
SWAPPED = {name: [jpeg(frame[..., ::-1]) for frame in video(LENGTH, 0)] for name in ("head_camera",)}
MARKED = {name: [jpeg(frame, RGB_MARK) for frame in video(LENGTH, 0)] for name in ("head_camera",)}


def pixels(files: list[bytes]) -> UInt8Array:
    return np.stack([decoded(each) for each in files])


def frames_of(dataset: Dataset, camera: str) -> UInt8Array:
    return np.stack(list(dataset.frames(dataset.episodes[0], camera)))


def test_red_and_blue_are_as_the_mark_of_robotwin_says_unless_the_caller_does(tmp_path: Path) -> None:
    file = writers.write_robotwin(tmp_path, SWAPPED)
    stored = pixels(SWAPPED["head_camera"])
    (line,) = (note for note in open_dataset(file).notes if note.startswith("channels: "))
    assert line == (
        "channels: head_camera bgr (RoboTwin's JPEG files without its mark of RGB, from before September 2026, store "
        "red as blue; --channels rgb leaves them)"
    )
    told: Any
    for told in ("rgb", {"head_camera": "rgb"}):
        dataset = open_dataset(file, channels=told)
        assert not any(note.startswith("channels: ") for note in dataset.notes)
        np.testing.assert_array_equal(frames_of(dataset, "head_camera"), stored)


def test_files_of_a_camera_with_and_without_the_mark_are_refused(tmp_path: Path) -> None:
    file = writers.write_robotwin(tmp_path, {"head_camera": [*MARKED["head_camera"][:3], *SWAPPED["head_camera"][3:]]})
    dataset = open_dataset(file)
    with pytest.raises(DatasetError, match="observation/head_camera/rgb: expected JPEG files all with RoboTwin's mark"):
        dataset.check(dataset.episodes[0], "head_camera")


BROKEN: dict[str, tuple[bytes, str]] = {
    "cut off": (FILES["left"][3][:-100], "expected a whole JPEG file, got one without an end"),
    "no picture": (b"no picture", "expected an image, got "),
    "empty": (b"", "expected an image, got "),
}


@pytest.mark.parametrize(("stored", "message"), BROKEN.values(), ids=BROKEN)
@pytest.mark.parametrize("layout", ["ALOHA", "RoboTwin", "RoboMIND"])
def test_broken_bytes_are_an_error_with_file_camera_and_frame(
    tmp_path: Path, layout: str, stored: bytes, message: str
) -> None:
    files = {"high": FILES["high"], "left": [*FILES["left"][:3], stored, *FILES["left"][4:]]}
    if layout == "ALOHA":
        file, path = writers.write_aloha(tmp_path / "episode_0.hdf5", files, task=TASK), "observations/images/left"
    elif layout == "RoboTwin":
        file, path = writers.write_robotwin(tmp_path, files), "observation/left/rgb"
    else:
        file, path = writers.write_robomind(tmp_path / "t.hdf5", files), "observations/rgb_images/left"
    dataset = open_dataset(file)
    for read in (lambda: dataset.check(dataset.episodes[0], "left"), lambda: frames_of(dataset, "left")):
        with pytest.raises(DatasetError) as refused:
            read()
        assert str(refused.value).startswith(f"{file}: {path}: frame 3: {message}")
    with pytest.raises(DatasetError, match=f"{path}: frame 3"):
        label(dataset, BrightnessScorer(), LabelOptions(output=tmp_path))


def test_a_first_frame_that_is_broken_does_not_hide_its_camera(tmp_path: Path) -> None:
    files = {"high": FILES["high"], "left": [b"no picture", *FILES["left"][1:]]}
    dataset = open_dataset(writers.write_robomind(tmp_path / "t.hdf5", files))
    with pytest.raises(DatasetError, match="left: frame 0: expected an image"):
        label(dataset, BrightnessScorer(), LabelOptions(output=tmp_path))


def test_a_frame_of_another_size_is_refused(tmp_path: Path) -> None:
    files = {"high": [*FILES["high"][:4], jpeg(video(1)[0, :40]), FILES["high"][5]]}
    dataset = open_dataset(writers.write_robomind(tmp_path / "t.hdf5", files))
    with pytest.raises(DatasetError, match="high: frame 4: expected a frame of 48 x 64 pixels, as the first, got 40 x"):
        frames_of(dataset, "high")


@pytest.mark.parametrize("attributes", [{"task": TASK}, {"instruction": np.bytes_(TASK)}, {"language": TASK}])
def test_the_task_may_be_an_attribute(tmp_path: Path, attributes: Any) -> None:
    file = writers.write_aloha(tmp_path / "episode_0.hdf5", {"high": video(LENGTH)}, **attributes)
    assert open_dataset(file).episodes[0].task == TASK


def test_a_file_without_a_task_says_where_it_was_sought(tmp_path: Path) -> None:
    file = writers.write_aloha(tmp_path / "data/episode0.hdf5", {"high": video(LENGTH)})
    writers.write_robotwin(tmp_path / "other", MARKED)
    shutil.copytree(tmp_path / "other/instructions", tmp_path / "instructions")  # of another layout
    with pytest.raises(DatasetError) as refused:
        _ = open_dataset(file).episodes
    assert f"{file}: attribute or dataset language_instruction, instruction, task, language_raw, or " in str(
        refused.value
    )
    assert str(refused.value).splitlines()[0].endswith('got none: add --task "SENTENCE"')
    assert open_dataset(file, task=TASK).episodes[0].task == TASK


def test_several_sentences_in_a_file_are_no_task(tmp_path: Path) -> None:
    file = writers.write_robomind(tmp_path / "t.hdf5", {"high": FILES["high"]}, task=None)
    with h5py.File(file, "r+") as stored:
        stored["language_raw"] = np.array([TASK, "another"], h5py.string_dtype())
    with pytest.raises(DatasetError, match=r"expected a task as a sentence, got .*another"):
        _ = open_dataset(file).episodes


def test_the_task_of_robotwin_is_the_first_sentence_of_its_side_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = writers.write_robotwin(tmp_path, MARKED)
    monkeypatch.chdir(file.parent)
    assert open_dataset(file.name).episodes[0].task == TASK
    assert "task: the first of 3 sentences in instructions/episode0.json" in open_dataset(file).notes
    (tmp_path / "instructions/episode0.json").write_text("[")
    with pytest.raises(DatasetError, match=r'episode0\.json: expected a JSON object \{"seen": \[sentences\]\}'):
        open_dataset(file)


def test_robomimics_layout_may_hold_files_too(tmp_path: Path) -> None:
    file = tmp_path / "demos.hdf5"
    with h5py.File(file, "w") as stored:
        frames = stored.create_dataset("data/demo_0/obs/front", (LENGTH,), dtype=h5py.vlen_dtype(np.uint8))
        frames[:] = [np.frombuffer(each, np.uint8) for each in FILES["high"]]
    np.testing.assert_array_equal(frames_of(open_dataset(file, task=TASK), "front"), pixels(FILES["high"]))
