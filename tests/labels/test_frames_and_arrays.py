# SPDX-License-Identifier: MIT
"""Episodes as frame folders, folders with HDF5 files, and layouts without a reader."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image

from hdf5_writers import write_robomimic
from labelling import LEROBOT, BrightnessScorer, brightness, command
from paths import ROOT
from pictures import numbered, write_video
from rfm_client.command_line import ExitCode
from rfm_labels import DatasetError, LabelOptions, label, open_dataset, read_episode_labels

TASK = "stack the cups"
COUNT = 12  # frames of an episode; more than 10, so 10.png exists


def write_frames(folder: Path, frames: Any, suffix: str = ".png") -> None:
    folder.mkdir(parents=True)
    for t, frame in enumerate(frames):
        Image.fromarray(frame).save(folder / f"frame_{t}{suffix}")


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    root = tmp_path / "frames"
    for name in ("0", "2", "10"):
        write_frames(root / name, numbered(COUNT))
    return root


@pytest.mark.parametrize("column", ["video", "episode"])
def test_a_table_names_folders_their_tasks_and_their_order(folders: Path, column: str) -> None:
    for camera in ("front", "wrist"):
        write_frames(folders / "11" / camera, numbered(3))
    (folders / "tasks.csv").write_text(f"{column},task\n10,open the box\n11/front,{TASK}\n")
    dataset = open_dataset(folders)
    assert [(e.name, e.task, e.num_frames) for e in dataset.episodes] == [
        ("10", "open the box", COUNT),
        ("11/front", TASK, 3),
    ]
    assert dataset.notes == ["tasks.csv leaves out folders of pictures beside it, which get no labels: 0, 2"]
    (folders / "tasks.csv").write_text(f"{column},task\n2/frame_*.png,{TASK}\n")
    with pytest.raises(
        DatasetError, match=r"got 2/frame_\*\.png: name the pictures by --videos '{episode}/frame_\*\.png'"
    ):
        open_dataset(folders)


def depth(root: Path) -> None:
    Image.fromarray(np.zeros((4, 4), np.uint16)).save(root / "2" / "frame_0.png")


BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "an empty folder": (
        lambda root: (root / "3").mkdir(),
        "3: expected PNG or JPEG files, got an empty folder: leave it out (--episodes)",
    ),
    "a listed folder that is not there": (
        lambda root: (root / "tasks.csv").write_text(f"episode,task\n11,{TASK}\n10,{TASK}\n"),
        "11: expected a folder of PNG or JPEG files, got No such file",
    ),
    "a folder of other files": (
        lambda root: [(root / "3").mkdir(), (root / "3" / "a.txt").write_text("a")],
        "3: expected PNG or JPEG files, got a.txt: name videos by a pattern (--videos), or leave it out (--episodes)",
    ),
    "folders of cameras": (
        lambda root: write_frames(root / "3" / "front", numbered(2)),
        "3: expected PNG or JPEG files, got the folders front: if they are cameras, --videos '{episode}/{camera}/*.png' names",
    ),
    "two formats": (
        lambda root: Image.fromarray(numbered(1)[0]).save(root / "2" / "x.jpg"),
        "got frame_*.png (12) and x.jpg (1): name the frame's number and the camera, as --videos '{episode}/frame_*.png'",
    ),
    "no picture": (
        lambda root: (root / "2" / "frame_1.png").write_bytes(b"x"),
        "frame_1.png: expected an image, got ",
    ),
    "a depth map": (depth, "frame_0.png: expected a picture of 8-bit colours (convert it"),
}


@pytest.mark.parametrize(("break_it", "message"), BROKEN.values(), ids=BROKEN)
def test_a_folder_without_frames_is_refused_before_a_score(
    folders: Path, break_it: Callable[[Path], object], message: str
) -> None:
    break_it(folders)
    scorer = BrightnessScorer()
    with pytest.raises(DatasetError) as refused:
        label(open_dataset(folders, task=TASK), scorer, LabelOptions())
    assert message in str(refused.value)
    assert scorer.num_samples == 0


def test_a_table_lists_episodes_of_one_kind(folders: Path) -> None:
    write_video(folders / "a.mp4", numbered(2))
    (folders / "tasks.csv").write_text(f"video,task\n0,{TASK}\na.mp4,{TASK}\n")
    with pytest.raises(
        DatasetError, match=r"got folders of pictures \(0\) and videos \(a\.mp4\): write a table for each"
    ):
        open_dataset(folders)


def test_a_file_whose_name_looks_like_a_pattern_is_a_file(tmp_path: Path) -> None:
    write_video(tmp_path / "a*b.mp4", numbered(2))
    (tmp_path / "a*b.txt").touch()
    for task in (TASK, None):
        dataset = open_dataset(tmp_path, task=task)
        assert ([episode.name for episode in dataset.episodes], *dataset.notes) == (["a*b.mp4"],)
        (tmp_path / "tasks.csv").write_text(f"video,task\na*b.mp4,{TASK}\n")


def test_a_table_of_before_is_refused_also_with_a_task_for_all(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", numbered(2))
    (tmp_path / "tasks.json").touch()
    with pytest.raises(DatasetError, match=r"expected tasks\.csv .*, got tasks\.json: write it as tasks\.csv"):
        open_dataset(tmp_path, task=TASK)


def write_demos(file: Path, task: str) -> None:
    write_robomimic(file, [{"front": numbered(5)}], task)


def asked(source: Path, labels: LabelOptions, *, dry_run: bool = False) -> tuple[int, list[str], set[str]]:
    """Return the exit code, the output lines, and the scored tasks."""
    scorer, said = BrightnessScorer(), list[str]()
    return command(source, labels, scorer, said.append, dry_run=dry_run), said, scorer.tasks


def test_a_folder_of_hdf5_files_is_labelled_file_by_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = tmp_path / "libero"
    for name, task in (("task_2.hdf5", "a"), ("task_10.hdf5", "b"), ("more/task_1.h5", "c")):
        write_demos(root / name, task)
    code, said, tasks = asked(root, LabelOptions())
    assert (code, tasks) == (ExitCode.OK, {"a", "b", "c"})
    files = [f"{root}/more/task_1.h5", f"{root}/task_2.hdf5", f"{root}/task_10.hdf5"]
    assert [line for line in said if line in files] == files
    (cameras,) = [line for line in said if line.startswith("note: cameras: ")]
    assert f"note: 3 of 3 files: {cameras.removeprefix('note: ')}" in said
    for folder, stem in (("more", "task_1"), ("", "task_2"), ("", "task_10")):
        labels = read_episode_labels(root / folder / f"{stem}.rfm_progress.parquet", 0)
        assert labels is not None
        np.testing.assert_allclose(labels.fused.progress, brightness(numbered(5)), atol=1e-6)
    for folder in (root, root / "more"):
        (folder / "task_2.rfm_rewards.hdf5").write_bytes(b"labels of 0.4")
    assert asked(root, LabelOptions())[::2] == (ExitCode.OK, set())  # files of labels are no datasets
    capsys.readouterr()


REFUSED_FOLDERS: dict[str, tuple[LabelOptions, str]] = {
    "one name twice": (
        LabelOptions(output=Path("out")),
        r"output: expected .* names differ, got .*a\.h5.*: leave out --o",
    ),
    "a file without pictures": (LabelOptions(), r"low_dim\.hdf5: data/demo_0/obs: expected a camera as uint8"),
}


@pytest.mark.parametrize(("labels", "message"), REFUSED_FOLDERS.values(), ids=REFUSED_FOLDERS)
def test_a_folder_of_hdf5_files_is_refused_before_a_score(tmp_path: Path, labels: LabelOptions, message: str) -> None:
    write_demos(tmp_path / "a.hdf5", TASK)
    write_demos(tmp_path / "b" / "a.h5", TASK)
    with h5py.File(tmp_path / "low_dim.hdf5", "w") as opened:
        opened["data/demo_0/obs/states"] = np.zeros((5, 3))
    with pytest.raises(DatasetError, match=message):
        asked(tmp_path, labels)
    assert not list(tmp_path.rglob("*.parquet"))


UNREAD: dict[str, tuple[list[str], str, str]] = {  # files, the opened path, the end of the message
    "TFRecord files alone": (["1.0.0/a.tfrecord-00000-of-00001"], "1.0.0", "got TFRecord files without features.json"),
    "Zarr": ([".zgroup", "data/.zgroup"], "", "got Zarr arrays: write a reader of ten lines (--reader"),
    "Zarr in an archive": (
        ["buffer.zarr.zip"],
        "buffer.zarr.zip",
        "got Zarr arrays: write a reader of ten lines (--reader",
    ),
    "a rosbag of ROS 2": (["metadata.yaml", "a_0.db3"], "", "got a rosbag: write a reader of ten lines (--reader"),
    "a rosbag of ROS 1": (["a.bag"], "a.bag", "got a rosbag: write a reader of ten lines (--reader"),
    "MCAP files": (["a.mcap", "b.mcap"], "", "got a rosbag: write a reader of ten lines (--reader"),
    "LeRobot v1": (["meta_data/info.json"], "", "got a LeRobot dataset of v1: convert it to v2.0 with LeRobot 0.3"),
    "HDF5 files in folders": (["a/x.hdf5"], "", "each a dataset of its own: rfm-client label takes the folder, open_"),
    "pictures": (["1.png", "2.png"], "", "got pictures outside of the folder of an episode"),
    "pictures of cameras": (["a/front/1.jpg"], "", "perhaps --videos '{episode}/front/*.jpg'; or write a reader"),
    "a video in a deeper folder": (
        ["a/b/episode_000000.mp4"],
        "",
        "--videos '{episode}.mp4' if each is an episode; or write",
    ),
    "pictures and a video": (
        ["0/1.png", "a.mp4"],
        "",
        "got videos (a.mp4) and folders of pictures (0): list the episodes of one kind in tasks.csv",
    ),
    "HDF5 files and videos": (["a.hdf5", "a.mp4"], "", "of one kind, got videos (a.mp4) and HDF5 files (a.hdf5): list"),
    "arrays": (["a.npz"], "", "each episode in it, or write a reader of ten lines (--reader; examples/readers)"),
    "pictures beside folders": (
        ["0/1.png", "1.png"],
        "",
        "got folders of pictures (0) and pictures (1.png): list the",
    ),
    "folders without a table": (
        ["0/1.png"],
        "",
        "with the task of each folder, got none: write it, or, if all of them",
    ),
    "a video": (["a.mp4"], "a.mp4", 'got a video: label its folder, with --task "SENTENCE" or with tasks.csv in it'),
    "videos without a table": (
        ["a.mp4"],
        "",
        'got none: write it, or, if all of them have one task, give it: --task "SE',
    ),
    "a table of before": (
        ["a.mp4", "tasks.json"],
        "",
        "got tasks.json: write it as tasks.csv, with the columns video and",
    ),
    "an empty folder": ([".hidden"], "", "got an empty folder: put a video or a folder of pictures for each"),
    "other files": (["a.txt"], "", "got other files: put a video or a folder of pictures for each episode"),
    "another file": (["a.txt"], "a.txt", "or a Hub id org/name[@revision], got another file"),
}


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:%064d\nsize 1048576\n" % 1
LEROBOT_FILES = (LEROBOT / "toy_v21", "data/chunk-000/episode_000000.parquet")
CLONED: dict[str, tuple[Path | None, str]] = {  # a copied dataset, and its file that git-lfs did not fetch
    "a table of rows": LEROBOT_FILES,
    "a video": (LEROBOT_FILES[0], "videos/chunk-000/observation.images.wrist/episode_000000.mp4"),
    "records": (ROOT / "tests/rlds/toy_steps_texts/1.0.0", "toy_steps_texts-train.tfrecord-00000-of-00002"),
    "an HDF5 file": (None, "a.hdf5"),
    "a picture": (None, "0/1.png"),
}


@pytest.mark.parametrize(("source", "name"), CLONED.values(), ids=CLONED)
def test_files_cloned_without_git_lfs_are_refused_with_the_command_that_fetches_them(
    tmp_path: Path, source: Path | None, name: str
) -> None:
    root = tmp_path / "data"
    if source is not None:
        shutil.copytree(source, root)
    (root / name).parent.mkdir(parents=True, exist_ok=True)
    (root / name).write_bytes(POINTER)
    with pytest.raises(DatasetError, match="got Git LFS's note of where it is; `git lfs pull` fetches it"):
        label(open_dataset(root / name if name.endswith("5") else root, task=TASK), BrightnessScorer(), LabelOptions())


@pytest.mark.parametrize(
    ("name", "got"),
    [
        ("/nothing/here", "none: there is no /nothing/here"),
        ("no dataset", f"none: there is no {Path.cwd()}/no dataset"),
        ("hf://datasets/onlyone", "another address"),
    ],
)
def test_a_missing_dataset_is_refused(name: str, got: str) -> None:
    with pytest.raises(DatasetError, match=f"^{name}: expected a LeRobot dataset .* got {re.escape(got)}$"):
        open_dataset(name)


@pytest.mark.parametrize(("files", "opened", "message"), UNREAD.values(), ids=UNREAD)
def test_an_unsupported_layout_is_refused_with_a_remedy(
    tmp_path: Path, files: list[str], opened: str, message: str
) -> None:
    root = tmp_path / "data"
    for name in files:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"x")
    with pytest.raises(DatasetError) as refused:
        open_dataset(root / opened)
    assert message.replace("ROOT", str(root)) in str(refused.value)
