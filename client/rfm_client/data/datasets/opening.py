# SPDX-License-Identifier: MIT
"""Open a dataset by path or Hub id, or say how to convert its layout."""

from __future__ import annotations

import re
from pathlib import Path

from rfm_client.data.datasets.hdf5 import ALOHA, ALOHA_GROUP, SUFFIXES, Hdf5Dataset
from rfm_client.data.datasets.lerobot import LeRobotDataset
from rfm_client.data.datasets.lerobot_rows import INFO_FILE
from rfm_client.data.datasets.protocol import Dataset, DatasetError, TaskOverride, require
from rfm_client.data.datasets.videos import TABLES, VideoFolder
from rfm_client.data.orientation import Orient

_HUB_ID = re.compile(r"([\w.-]+/[\w.-]+)(?:@([\w./-]+))?")
_LAYOUTS = (
    f"a LeRobot dataset ({INFO_FILE}), an HDF5 file ({', '.join(SUFFIXES)}), "
    f"a folder of videos with {' or '.join(TABLES)}, or a Hub id org/name[@revision]"
)
_TABLE = "list the videos in tasks.csv (columns video, task)"
_UNREAD = {  # remedies for layouts without a reader, by pattern of file names
    r"meta_data": "a LeRobot dataset of v1: convert it to v2.0 with convert_dataset_v1_to_v2.py of lerobot/datasets/v2 "
    "(LeRobot 0.3), and label that",
    r"features\.json|.*\.tfrecord.*": "an RLDS (TensorFlow) dataset: convert it to LeRobot with openx2lerobot of "
    "https://github.com/Tavish9/any4lerobot",
    r".*\.zarr(\.zip)?|\.z(group|array|attrs|metadata)|zarr\.json": "Zarr arrays: convert them to LeRobot with "
    "https://github.com/arpitg1304/forge, or write each episode's pictures to a video "
    f"(imageio.mimwrite('0.mp4', frames, fps=10)) and {_TABLE}",
    r".*\.(bag|mcap|db3)": "a rosbag: convert it to LeRobot with https://github.com/arpitg1304/forge, or write each "
    f"camera's topic to a video (the package rosbags reads it without ROS) and {_TABLE}",
}
_PICTURES, _VIDEOS = ("png", "jpg", "jpeg"), ("mp4", "mkv", "mov", "webm", "avi")


def open_dataset(
    source: str | Path, *, task: str | None = None, override_task: bool = False, orient: Orient = Orient()
) -> Dataset:
    """Return the dataset at a path, or download the Hub id ``org/name[@revision]``. An existing path wins.

    task: task of episodes without their own
    override_task: True: ``task`` is the task of all episodes
    orient: turn of each camera's frames. HDF5 files marked as LIBERO's are turned by default

    Raises DatasetError.
    """
    path, given = Path(source), TaskOverride(task, override_task)
    if path.is_file() and path.suffix.lower() in SUFFIXES:
        return Hdf5Dataset(path, task=given, orient=orient)
    if (path / INFO_FILE).is_file():
        return LeRobotDataset(path, task=given, orient=orient)
    if path.exists():
        has_table = path.suffix.lower() in (".csv", ".json") or any((path / table).is_file() for table in TABLES)
        other = None if has_table else _unread(path)
        require(path, has_table or (other is None and path.is_dir()), _LAYOUTS, other or "another file")
        return VideoFolder(path, task=given, orient=orient)
    match = _HUB_ID.fullmatch(str(source))
    if match is None:
        raise DatasetError.at(source, _LAYOUTS, "none")
    return _from_hub(match[1], match[2], given, orient)


def _from_hub(name: str, revision: str | None, task: TaskOverride, orient: Orient) -> LeRobotDataset:
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise ImportError('datasets of the Hub need huggingface-hub: pip install "./client[label]"') from error
    try:
        folder = Path(snapshot_download(name, repo_type="dataset", revision=revision))
    except (OSError, ValueError) as error:  # the Hub's library raises these, errors of requests included
        raise DatasetError.at(name, "a local dataset or one of the Hub", str(error).splitlines()[0]) from error
    if not (folder / INFO_FILE).is_file():
        raise DatasetError.at(name, f"a LeRobot dataset's {INFO_FILE}", _unread(folder) or "none")
    commit = folder.name  # the name of a snapshot's folder
    return LeRobotDataset(folder, source=name, revision=commit, task=task, orient=orient)


def _unread(path: Path) -> str | None:
    """A known layout without a reader, and its remedy; None: the layout is unknown."""
    found = [path] if path.is_file() else [each for below in ("*", "*/*") for each in path.glob(below)]
    names = [path.name, *(each.name for each in found)]
    for pattern, what in _UNREAD.items():
        if any(re.fullmatch(pattern, name, re.IGNORECASE) for name in names):
            return what
    if path.is_file():
        is_video = path.suffix.lower().lstrip(".") in _VIDEOS
        return "a video: label its folder, with tasks.csv in it (columns video, task)" if is_video else None
    if files := _pattern(path, [suffix.lstrip(".") for suffix in SUFFIXES]):
        loop = f'for f in {files}; do rfm-client label "$f"; done'
        return ALOHA if _is_aloha(path, files) else f"a folder of HDF5 files, each a dataset of its own: {loop}"
    pictures = None if _pattern(path, _VIDEOS) else _pattern(path, _PICTURES)
    if pictures is None:
        return None
    encoding = "ffmpeg -framerate 10 -i - -c:v libx264rgb -crf 0"
    if pictures.parent == path:
        video = f"cat $(ls -v {pictures}) | {encoding} {path}/0.mp4"
    else:
        video = f"for e in {pictures.parent}/; do cat $(ls -v $e{pictures.name}) | {encoding} ${{e%/}}.mp4; done"
    return f"a folder of pictures: make a video of each episode ({video}) and {_TABLE}"


def _is_aloha(folder: Path, pattern: Path) -> bool:
    try:
        import h5py

        with h5py.File(next(iter(folder.glob(str(pattern.relative_to(folder))))), "r") as opened:
            return ALOHA_GROUP in opened
    except (ImportError, OSError):  # treated as any folder of HDF5 files
        return False


def _pattern(folder: Path, suffixes: tuple[str, ...] | list[str]) -> Path | None:
    """Glob pattern of files with one of these suffixes, in the folder or a level below; None: no such files."""
    patterns = [f"{below}*.{suffix}" for below in ("", "*/") for suffix in suffixes]
    return next((folder / pattern for pattern in patterns if any(folder.glob(pattern))), None)
