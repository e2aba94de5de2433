# SPDX-License-Identifier: MIT
"""HDF5 files as robomimic and LIBERO lay them out: ``data/demo_<i>/obs/<camera>``. Needs ``rfm-client[hdf5]``.

The task is LIBERO's sentence (``problem_info`` of ``data``), robomimic's own (``env_args``), or one that the caller
gives. LIBERO stores its pictures upside down: they are turned, unless the caller says otherwise.
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
from rfm_client.data.datasets.hdf5_pictures import CAMERA_FORM, fault, listed, pictures_in
from rfm_client.data.datasets.other_layouts import ALOHA, ALOHA_GROUP
from rfm_client.data.datasets.protocol import Contents, DatasetError, Episode, GivenTask, contents_of, orientations_of
from rfm_client.data.orientation import Orient, Orientation, turned

SUFFIXES = (".hdf5", ".h5")
FRAMES_AT_A_TIME = 64

_DEMO = re.compile(r"demo_(\d+)$")
_SENTENCES = ("language_instruction", "language", "lang")  # where problem_info and env_args may hold it
_LIBERO: Orientation = "flip-vertical"  # as upstream's training data and evaluation turn it
_LIBERO_CAMERAS = ("agentview_rgb", "eye_in_hand_rgb")
_NO_PICTURES = "robomimic's dataset_states_to_obs.py renders the pictures of a low-dimensional file"


class Hdf5Dataset:
    """The demonstrations of one file.

    task: what the caller says of their task
    orient: how pictures are turned; a camera of which it does not speak is turned if the file says that it is LIBERO's
    """

    kind = "HDF5"
    revision = None
    depth_cameras: Sequence[str] = ()  # depth maps are not uint8 [T, H, W, 3]

    def __init__(self, file: Path, *, task: GivenTask = GivenTask(), orient: Orient = Orient()) -> None:
        self.file = file
        self.root = file.parent
        self.source = file.name
        self._task = task
        with self._opened() as opened:
            demos = self._demos_in(opened)
            self._demos = {index: name for index, (name, _) in demos.items()}
            self.cameras, self.left_out = self._cameras_in(dict(demos.values()))
            is_libero, is_upright = _is_libero(opened["data"].attrs), _is_upright(opened["data"].attrs)
        defaults: dict[str, Orientation] = dict.fromkeys(self.cameras, _LIBERO) if is_libero and not is_upright else {}
        self.orientations = orientations_of(orient, self.cameras, defaults)
        untold = [camera for camera in self.cameras if orient.default is None and camera not in orient.cameras]
        self.notes = [] if is_upright else _notes(untold, is_libero)

    @cached_property
    def episodes(self) -> Sequence[Episode]:
        """All demonstrations, by their numbers. Raises DatasetError."""
        with self._opened() as opened:
            task = self._task.of(f"{self.file}: problem_info or env_args", _task_of(opened["data"].attrs))
            lengths = {name: self._length(opened, name) for name in self._demos.values()}
        firsts = np.cumsum([0, *lengths.values()]).tolist()
        episodes = [
            Episode(index, name, task, lengths[name], first)
            for (index, name), first in zip(self._demos.items(), firsts, strict=False)
        ]
        self._task.check_used(episodes)
        return episodes

    def decoder(self, camera: str) -> str | None:
        """None: frames are stored as pixels."""
        return None

    def check(self, episode: Episode, camera: str) -> Contents:
        """What the frames are made of, as they are stored. Reads all of them; raises DatasetError."""
        return contents_of(frame.tobytes() for frame in self._stored(episode, camera))

    def frames(self, episode: Episode, camera: str) -> Iterator[UInt8Array]:
        """The frames, uint8 [H, W, 3], turned as ``orientations`` says. Raises DatasetError."""
        orientation = self.orientations.get(camera, "none")
        return (turned(frame, orientation) for frame in self._stored(episode, camera))

    def _stored(self, episode: Episode, camera: str) -> Iterator[UInt8Array]:
        where = f"{self.file}: data/{episode.name}/obs/{camera}"
        with self._opened() as opened:
            film = opened["data"][episode.name]["obs"].get(camera)
            if film is None or fault(film) or len(film) != episode.num_frames:
                got = "none" if film is None else f"{film.dtype} {list(film.shape)}"
                raise DatasetError.at(where, f"uint8 [{episode.num_frames}, H, W, 3]", got)
            for start in range(0, episode.num_frames, FRAMES_AT_A_TIME):
                try:
                    yield from film[start : start + FRAMES_AT_A_TIME]
                except OSError as error:
                    raise DatasetError.at(where, "readable frames", str(error)) from error

    def _demos_in(self, opened: Any) -> dict[int, tuple[str, Any]]:
        """Name and content of each demonstration, by its number. Raises DatasetError."""
        if ALOHA_GROUP in opened:
            raise DatasetError.at(self.file, "data/demo_0/obs/<camera>", ALOHA)
        group = opened.get("data")
        names = list(group) if hasattr(group, "keys") else []
        demos = {int(match[1]): (name, group[name]) for name in names if (match := _DEMO.match(name))}
        if not demos:
            got = ", ".join(names) or f"none: the file holds {', '.join(opened) or 'nothing'}"
            raise DatasetError.at(f"{self.file}: data", "demo_0, demo_1 and so on", got)
        return dict(sorted(demos.items()))

    def _cameras_in(self, demos: Mapping[str, Any]) -> tuple[Sequence[str], Mapping[str, str]]:
        """The cameras of all demonstrations, and other pictures with what is wrong. Raises DatasetError if all are."""
        faults = pictures_in(demos)
        cameras = tuple(name for name, reason in faults.items() if not reason)
        if not cameras:
            name, first = next(iter(demos.items()))
            told = "; ".join(f"{picture}: {reason}" for picture, reason in faults.items())
            got = told or f"{listed(first.get('obs', {}))}: {_NO_PICTURES}"
            raise DatasetError.at(f"{self.file}: data/{name}/obs", f"{CAMERA_FORM} in every demonstration", got)
        return cameras, {name: reason for name, reason in faults.items() if reason}

    def _length(self, opened: Any, name: str) -> int:
        """T of a demonstration: that of its actions, if there are some, and of each camera."""
        demo = opened["data"][name]
        lengths = {f"obs/{camera}": len(demo["obs"][camera]) for camera in self.cameras}
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


def _notes(untold: Sequence[str], is_libero: bool) -> Sequence[str]:
    """What is to be said of cameras of whose orientation the caller has told nothing."""
    if is_libero and untold:
        why = "LIBERO stores its pictures upside down; --orient none leaves them"
        return [f"orient: {', '.join(untold)} {_LIBERO} ({why})"]
    doubtful = [camera for camera in untold if camera in _LIBERO_CAMERAS]
    if not doubtful:
        return []
    advice = f"look at a frame, and turn them with --orient {_LIBERO} if they are upside down"
    why = "as stored, but LIBERO, which names cameras so, stores them upside down"
    return [f"orient: {', '.join(doubtful)} {why}: {advice}"]


def _is_libero(attributes: Mapping[str, Any]) -> bool:
    """Whether the file says that LIBERO wrote it."""
    env_names = (attributes.get("env_name"), _document(attributes, "env_args").get("env_name"), attributes.get("tag"))
    has_problem = not {"problem_name", "language_instruction"}.isdisjoint(_document(attributes, "problem_info"))
    is_named = any("libero" in str(name).lower() for name in env_names)
    return has_problem or is_named or "bddl_file_name" in attributes


def _is_upright(attributes: Mapping[str, Any]) -> bool:
    """Whether the file says that robosuite rendered its pictures the right way up."""
    return "opencv" in str(attributes.get("macros_image_convention"))


def _document(attributes: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    try:
        document = json.loads(attributes.get(name, "{}"))
    except (ValueError, TypeError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}


def _task_of(attributes: Mapping[str, Any]) -> Any:
    documents = (_document(attributes, name) for name in ("problem_info", "env_args"))
    return next((found[key] for found in documents for key in _SENTENCES if found.get(key)), None)
