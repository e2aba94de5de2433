# SPDX-License-Identifier: MIT
"""Layouts that are not read: by what each is known, and how it becomes one that is."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

ALOHA_GROUP = "observations/images"
ALOHA = (
    "ALOHA's layout, an episode a file (observations/images): convert its folder to LeRobot with openpi's "
    "examples/aloha_real/convert_aloha_data_to_lerobot.py"
)

_TABLE = "list the videos in tasks.csv (columns video, task)"
_HDF5, _PICTURES, _FILMS = ("hdf5", "h5"), ("png", "jpg", "jpeg"), ("mp4", "mkv", "mov", "webm", "avi")
_BAGS = ("bag", "mcap", "db3")
_RLDS = (
    "an RLDS (TensorFlow) dataset: convert it to LeRobot with openx2lerobot of https://github.com/Tavish9/any4lerobot"
)
_ZARR = (
    "Zarr arrays: convert them to LeRobot with https://github.com/arpitg1304/forge, or write each episode's pictures "
    f"to a video (imageio.mimwrite('0.mp4', frames, fps=10)) and {_TABLE}"
)
_ROSBAG = (
    "a rosbag: convert it to LeRobot with https://github.com/arpitg1304/forge, or write each camera's topic to a video "
    f"(the package rosbags reads it without ROS) and {_TABLE}"
)
_LEROBOT_V1 = (
    "a LeRobot dataset of v1: convert it to v2.0 with convert_dataset_v1_to_v2.py of lerobot/datasets/v2 "
    "(LeRobot 0.3), and label that"
)


def described(path: Path) -> str | None:
    """What lies at a path that no reader takes, and what to do with it; None: nothing of a known form."""
    found = [path] if path.is_file() else [each for below in ("*", "*/*") for each in path.glob(below)]
    names = [path.name, *(each.name for each in found)]
    known = {
        _LEROBOT_V1: "meta_data" in names,
        _RLDS: _has(names, r"features\.json|.*\.tfrecord.*"),
        _ZARR: _has(names, r".*\.zarr(\.zip)?|\.z(group|array|attrs|metadata)|zarr\.json"),
        _ROSBAG: _has(names, rf".*\.({'|'.join(_BAGS)})"),
    }
    return next((what for what, is_it in known.items() if is_it), None) or _of_files(path)


def _of_files(path: Path) -> str | None:
    """What is to be done with files that could be read in another arrangement."""
    if path.is_file():
        is_film = path.suffix.lower().lstrip(".") in _FILMS
        return "a video: label its folder, with tasks.csv in it (columns video, task)" if is_film else None
    if found := _glob(path, _HDF5):
        loop = f'for f in {found}; do rfm-client label "$f"; done'
        is_aloha = _is_aloha(next(iter(path.glob(str(found.relative_to(path))))))
        return ALOHA if is_aloha else f"a folder of HDF5 files, each a dataset of its own: {loop}"
    if _glob(path, _FILMS):
        return None
    if found := _glob(path, _PICTURES):
        encoding = "ffmpeg -framerate 10 -i - -c:v libx264rgb -crf 0"
        if found.parent == path:
            film = f"cat $(ls -v {found}) | {encoding} {path}/0.mp4"
        else:
            film = f"for e in {found.parent}/; do cat $(ls -v $e{found.name}) | {encoding} ${{e%/}}.mp4; done"
        return f"a folder of pictures: make a video of each episode ({film}) and {_TABLE}"
    return None


def _is_aloha(file: Path) -> bool:
    try:
        import h5py

        with h5py.File(file, "r") as opened:
            return ALOHA_GROUP in opened
    except (ImportError, OSError):  # it is a folder of HDF5 files all the same
        return False


def _has(names: list[str], pattern: str) -> bool:
    return any(re.fullmatch(pattern, name, re.IGNORECASE) for name in names)


def _glob(folder: Path, suffixes: tuple[str, ...]) -> Path | None:
    """The pattern of the folder's files with one of these suffixes, or of those one level below; None: it has none."""
    patterns: Iterator[str] = (f"{below}*.{suffix}" for below in ("", "*/") for suffix in suffixes)
    return next((folder / pattern for pattern in patterns if any(folder.glob(pattern))), None)
