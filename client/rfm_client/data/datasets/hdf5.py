# SPDX-License-Identifier: MIT
"""HDF5 files as robomimic and LIBERO lay them out: ``data/demo_<i>/obs/<camera>``. Needs ``rfm-client[hdf5]``.

The task is LIBERO's sentence (``problem_info`` of ``data``), robomimic's own (``env_args``), or one that the caller
gives for all episodes.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rfm_client.contract.samples import UInt8Array
from rfm_client.data.datasets.protocol import Contents, DatasetError, Episode, checked_task, contents_of

SUFFIXES = (".hdf5", ".h5")
FRAMES_AT_A_TIME = 64

_DEMO = re.compile(r"demo_(\d+)$")
_SENTENCES = ("language_instruction", "language", "lang")  # where problem_info and env_args may hold it


class Hdf5Dataset:
    """The demonstrations of one file.

    task: what is to be done in all of them; None: what the file says
    """

    kind = "HDF5"
    revision = None
    depth_cameras: Sequence[str] = ()  # depth maps are not uint8 [T, H, W, 3]

    def __init__(self, file: Path, *, task: str | None = None) -> None:
        self.file = file
        self.root = file.parent
        self.source = file.name
        self._task = task
        with self._opened() as opened:
            group = opened.get("data")
            demos = {int(match[1]): name for name in group or () if (match := _DEMO.match(name))}
            if not demos:
                raise DatasetError.at(f"{file}: data", "demo_0, demo_1 and so on", ", ".join(group or ()) or "none")
            self._demos = dict(sorted(demos.items()))
            first = group[next(iter(self._demos.values()))]
            self.cameras: Sequence[str] = tuple(name for name, value in first.get("obs", {}).items() if _is_film(value))
        if not self.cameras:
            raise DatasetError.at(f"{file}: data/{next(iter(self._demos.values()))}/obs", "uint8 [T, H, W, 3]", "none")

    @cached_property
    def episodes(self) -> Sequence[Episode]:
        """All demonstrations, by their numbers. Raises DatasetError."""
        with self._opened() as opened:
            task = checked_task(f"{self.file}: problem_info or env_args", self._task or _task_of(opened["data"].attrs))
            lengths = {name: self._length(opened, name) for name in self._demos.values()}
        firsts = np.cumsum([0, *lengths.values()]).tolist()
        return [
            Episode(index, name, task, lengths[name], first)
            for (index, name), first in zip(self._demos.items(), firsts, strict=False)
        ]

    def check(self, episode: Episode, camera: str) -> Contents:
        """What the frames are made of. Reads all of them; raises DatasetError."""
        return contents_of(frame.tobytes() for frame in self.frames(episode, camera))

    def frames(self, episode: Episode, camera: str) -> Iterator[UInt8Array]:
        """The frames, uint8 [H, W, 3]. Raises DatasetError."""
        where = f"{self.file}: data/{episode.name}/obs/{camera}"
        with self._opened() as opened:
            film = opened["data"][episode.name]["obs"].get(camera)
            if film is None or not _is_film(film) or len(film) != episode.num_frames:
                got = "none" if film is None else f"{film.dtype} {list(film.shape)}"
                raise DatasetError.at(where, f"uint8 [{episode.num_frames}, H, W, 3]", got)
            for start in range(0, episode.num_frames, FRAMES_AT_A_TIME):
                try:
                    yield from film[start : start + FRAMES_AT_A_TIME]
                except OSError as error:
                    raise DatasetError.at(where, "readable frames", str(error)) from error

    def _length(self, opened: Any, name: str) -> int:
        """T of a demonstration: that of its actions, if there are some, and of each camera."""
        demo = opened["data"][name]
        films = demo.get("obs", {})
        missing = [camera for camera in self.cameras if camera not in films]
        if missing:
            raise DatasetError.at(f"{self.file}: data/{name}/obs", f"the camera {missing[0]}", "none")
        lengths = {f"obs/{camera}": len(films[camera]) for camera in self.cameras}
        lengths |= {"actions": len(demo["actions"])} if "actions" in demo else {}
        if len(set(lengths.values())) != 1 or 0 in lengths.values():
            got = ", ".join(f"{key} {length}" for key, length in lengths.items())
            raise DatasetError.at(f"{self.file}: data/{name}", "one length, above 0", got)
        return next(iter(lengths.values()))

    def _opened(self) -> Any:
        try:
            import h5py
        except ImportError as error:
            raise ImportError('HDF5 files need h5py: pip install "./client[hdf5]"') from error
        try:
            return h5py.File(self.file, "r")
        except OSError as error:
            raise DatasetError.at(self.file, "an HDF5 file", str(error)) from error


def _is_film(value: Any) -> bool:
    shape: tuple[int, ...] = getattr(value, "shape", ())
    return len(shape) == 4 and shape[3] == 3 and value.dtype == np.uint8


def _task_of(attributes: Mapping[str, Any]) -> Any:
    for name in ("problem_info", "env_args"):
        try:
            document = json.loads(attributes.get(name, "{}"))
        except (ValueError, TypeError, RecursionError):
            continue
        for key in _SENTENCES if isinstance(document, dict) else ():
            if document.get(key):
                return document[key]
    return None
