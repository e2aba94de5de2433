# SPDX-License-Identifier: MIT
"""RLDS datasets as TensorFlow Datasets writes them: episodes, frames, tasks, labels, and damaged files."""

from __future__ import annotations

import json
import shutil
import struct
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import pytest
from pyarrow import parquet

from labelling import BrightnessScorer, Notes, brightness
from paths import ROOT
from rfm_labels import DatasetError, LabelOptions, label, open_dataset

RLDS = ROOT / "tests" / "rlds"
CAMERAS = ("image", "wrist_image")
PLACES = ("train/0", "train/1", "train/2", "val/0", "val/1")  # of the episodes in the decoded files
FIRST = "toy_steps_texts-train.tfrecord-00000-of-00002"


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """A copy of the dataset with instructions in the steps."""
    return shutil.copytree(RLDS / "toy_steps_texts" / "1.0.0", tmp_path / "1.0.0")


def decoded() -> Mapping[str, Any]:
    """Frames and tasks as TensorFlow decodes them."""
    return dict(np.load(RLDS / "toy_steps_texts.npz"))


def tasks_of(episode: Any) -> list[str]:
    """The task of each frame."""
    return [task for task, length in episode.stretches for _ in range(length)]


def test_frames_and_tasks_equal_those_that_tensorflow_decodes() -> None:
    dataset, expected = open_dataset(RLDS / "toy_steps_texts"), decoded()
    assert (dataset.kind, dataset.source) == ("RLDS", "toy_steps_texts/1.0.0")
    assert [(e.num_frames, e.first_index) for e in dataset.episodes] == [(5, 0), (3, 5), (6, 8), (4, 14), (2, 18)]
    assert dataset.chosen_cameras() == CAMERAS
    for place, episode in zip(PLACES, dataset.episodes, strict=True):
        assert tasks_of(episode) == expected[f"{place}/task"].tolist()
        for camera in CAMERAS:
            np.testing.assert_array_equal(list(dataset.frames(episode, camera)), expected[f"{place}/{camera}"])


def test_a_missing_package_is_named_with_the_extra_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "google_crc32c", None)
    with pytest.raises(ImportError, match=r'pip install \./client "\./apps/labels\[rlds\]"'):
        label(open_dataset(RLDS / "toy_steps_texts"), BrightnessScorer(), LabelOptions())


def test_black_and_depth_pictures_are_left_out_with_a_line(output: Path) -> None:
    notes = Notes()
    report = label(open_dataset(RLDS / "toy_episode_texts"), BrightnessScorer(), LabelOptions(output=output), notes)
    assert "left out: depth: float32 [16, 16, 1]: expected 3 channels of uint8" in notes.lines
    assert "left out: image_padding: black pictures in every chosen episode" in notes.lines
    frames = decoded()
    expected = np.mean([np.concatenate([brightness(frames[f"{p}/{c}"]) for p in PLACES]) for c in CAMERAS], axis=0)
    np.testing.assert_allclose(parquet.read_table(report.files[0])["progress_sparse"], expected, rtol=0, atol=1e-6)
    with pytest.raises(
        DatasetError, match="got 'image_padding', which is left out: black pictures in every chosen episode"
    ):
        label(open_dataset(RLDS / "toy_episode_texts"), BrightnessScorer(), LabelOptions(cameras=("image_padding",)))


def of_steps(features: Any) -> Any:
    return features["featuresDict"]["features"]["steps"]["sequence"]["feature"]["featuresDict"]["features"]


def of_observations(features: Any) -> Any:
    return of_steps(features)["observation"]["featuresDict"]["features"]


def test_a_dataset_whose_cameras_are_all_black_is_refused(copied: Path) -> None:
    edited("features.json", lambda features: [of_observations(features).pop(camera) for camera in CAMERAS])(copied)
    with pytest.raises(DatasetError, match="a camera that shows something, got image_padding: black pictures in every"):
        label(open_dataset(copied), BrightnessScorer(), LabelOptions())


def test_a_task_is_the_first_instruction_that_is_not_blank_or_that_of_the_caller_s_choice(copied: Path) -> None:
    def add(features: Any) -> None:
        about = features["featuresDict"]["features"]["episode_metadata"]["featuresDict"]["features"]
        about["natural_language_instruction"] = about["file_path"]

    edited("features.json", add)(copied)
    dataset = open_dataset(copied)
    told = (
        "tasks: from episode_metadata/natural_language_instruction, where it is blank from steps/language_instruction"
    )
    assert (dataset.notes, dataset.episode(0).task) == ([told], "open the drawer")
    assert open_dataset(copied, task_column="file_path").episode(0).task.endswith(".hdf5")
    with pytest.raises(DatasetError, match=r"task_column: expected one of .*, steps/language_instruction, got 'gone'$"):
        open_dataset(copied, task_column="gone")


def test_a_text_named_instruction_is_the_task(copied: Path) -> None:
    def nest(features: Any) -> None:
        text = of_steps(features).pop("language_instruction")
        of_steps(features)["observat"] = {"featuresDict": {"features": {"instruction": text}}}

    edited("features.json", nest)(copied)
    rewritten(b"language_instruction", b"observat/instruction")(copied)
    assert open_dataset(copied).episode(0).task == "open the drawer"


def test_a_dataset_without_instructions_needs_a_task(copied: Path) -> None:
    edited("features.json", lambda features: of_steps(features).pop("language_instruction"))(copied)
    with pytest.raises(
        DatasetError, match=r"language_instruction or instruction: expected a task as a sentence, got none: add"
    ):
        _ = open_dataset(copied).episodes
    assert {episode.task for episode in open_dataset(copied, task="wave").episodes} == {"wave"}


def spoilt(change: Callable[[bytearray], object]) -> Callable[[Path], None]:
    """Change the first file, whose CRCs stay."""

    def apply(root: Path) -> None:
        content = bytearray((root / FIRST).read_bytes())
        change(content)
        (root / FIRST).write_bytes(content)

    return apply


def flip(position: int) -> Callable[[Path], None]:
    def change(content: bytearray) -> None:
        content[position] ^= 1

    return spoilt(change)


def rewritten(before: bytes, after: bytes) -> Callable[[Path], None]:
    """Replace bytes in the first record of the first file, and correct its CRC."""
    assert len(before) == len(after)

    def change(content: bytearray) -> None:
        (length,) = struct.unpack("<Q", content[:8])
        record = bytes(content[12 : 12 + length]).replace(before, after)
        crc = google_crc32c.value(record)
        masked = ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF
        content[12 : 16 + length] = record + struct.pack("<I", masked)

    return spoilt(change)


def edited(file: str, change: Callable[[Any], object]) -> Callable[[Path], None]:
    def apply(root: Path) -> None:
        document = json.loads((root / file).read_text())
        change(document)
        (root / file).write_text(json.dumps(document))

    return apply


def is_one_longer(info: Any) -> None:
    info["splits"][0]["shardLengths"][0] = "1"


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "a changed byte": (flip(200), r"00000-of-00002: record 0: expected content of the stored CRC, got another: the"),
    "a changed length": (flip(0), r"record 0: expected a length of the stored CRC, got another: the file is damaged"),
    "a truncated file": (spoilt(lambda content: content.__delitem__(slice(-9, None))), r"record 1: expected \d+ bytes"),
    "a lost file": (lambda root: (root / FIRST).unlink(), r"expected a file with 2 episodes, got none: copy or downl"),
    "more records": (edited("dataset_info.json", is_one_longer), r"expected 1 records, as dataset_info.json says, got"),
    "another text": (
        rewritten(b"open the drawer", b"open the \xff\xff\xff\xff\xff\xff"),
        r"instruction: expected a tas",
    ),
    "no text": (rewritten(b"open the drawer", b" " * 15), r"language_instruction: expected a task as a sentence, got"),
    "no picture": (rewritten(b"\x89PNG", b"\x00PNG"), r"record 0: wrist_image: frame 0: expected an image, got"),
    "other features": (
        rewritten(b"steps/observation/image", b"steps/observation/imagf"),
        r"got image 0, .*wrist_image 5",
    ),
}


@pytest.mark.parametrize(("damage", "message"), DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_file_is_refused_by_name_and_number_and_other_episodes_can_be_labelled(
    copied: Path, output: Path, damage: Callable[[Path], object], message: str
) -> None:
    damage(copied)
    scorer = BrightnessScorer()
    with pytest.raises(DatasetError, match=message):
        label(open_dataset(copied), scorer, LabelOptions(output=output))
    assert scorer.num_samples == 0
    last = max(open_dataset(copied).numbers)
    assert label(open_dataset(copied), scorer, LabelOptions(output=output, episodes=[last])).files


def leaves_the_folder(info: Any) -> None:
    info["splits"][1]["filepathTemplate"] = "../{DATASET}-{SPLIT}-{SHARD_INDEX}"


NOT_READ: dict[str, tuple[Callable[[Path], object], str]] = {
    "another format": (
        edited("dataset_info.json", lambda info: info.update(fileFormat="array_record")),
        r"fileFormat: expected tfrecord, got array_record: write it again with file_format='tfrecord'",
    ),
    "features of an old version": (
        edited("features.json", lambda features: features.clear()),
        r"features\.json: expected features as TensorFlow Datasets 4\.6 or later writes them, got none",
    ),
    "files elsewhere": (
        edited("dataset_info.json", leaves_the_folder),
        r"splits: val: expected files in the folder of the version, got \.\./toy_steps_texts-val-00000",
    ),
    "two versions": (
        lambda root: shutil.copytree(root, root.with_name("2.0.0")),
        r"expected one version of an RLDS dataset, got 1\.0\.0, 2\.0\.0: name one of these folders",
    ),
    "no metadata": (lambda root: (root / "features.json").unlink(), "got TFRecord files without features.json, which"),
}


@pytest.mark.parametrize(("change", "message"), NOT_READ.values(), ids=NOT_READ)
def test_an_unreadable_rlds_folder_is_refused_with_a_remedy(
    copied: Path, change: Callable[[Path], object], message: str
) -> None:
    change(copied)
    with pytest.raises(DatasetError, match=message):
        open_dataset(copied.parent)
