# SPDX-License-Identifier: MIT
"""Layouts of HDF5 files: where an episode has its pictures, actions and task.

An episode of every layout looks the same to the reader: ``{"obs": {camera: array}, "actions": array}`` with ``attrs``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfm_labels.datasets.faults import DatasetError
from rfm_labels.datasets.hdf5_contents import attribute, demonstrations, members_of, own_task_of, texts_in

_TRAJECTORY = re.compile(r"traj_(\d+)")
_TASK_NAMES = ("language_instruction", "instruction", "task", "language_raw")  # of datasets, and of attributes


@dataclass(frozen=True)
class Layout:
    """The paths in a file of one layout.

    group: of an episode; empty: the file is one episode
    pictures: of a camera, in the group
    actions: in the group; empty: not compared with the frames
    are_pictures: True: whatever is at ``pictures`` is a camera; False: the observations hold other arrays, too
    fps: the writer's default; None: in the attributes
    skipped: number of pictures before the first frame
    without_pictures: remedy for a file without pictures
    colours: note on the order of colours in encoded frames
    """

    name: str
    group: str
    pictures: str
    actions: str = ""
    are_pictures: bool = True
    fps: float | None = None
    skipped: int = 0
    without_pictures: str = "record the episode with its cameras"
    colours: str = ""

    @property
    def is_in_data(self) -> bool:
        """True for demonstrations in ``data``, with robomimic's attributes and filter keys."""
        return self.group == "data/{demo}"

    def group_of(self, demo: str) -> str:
        """Return the path of the group of ``demo_<number>``; empty: the file."""
        return self.group.format(demo=demo, number=demo.removeprefix("demo_"))

    def path_of(self, demo: str, camera: str) -> str:
        """Return the path of a camera's frames."""
        return f"{self.group_of(demo)}/{self.pictures.format(camera=camera)}".lstrip("/")

    def cameras_at(self, demo: str) -> str:
        """Return the path above the cameras."""
        return self.path_of(demo, "{camera}").partition("{camera}")[0].rstrip("/")

    def episodes(self, file: Path, opened: Any) -> dict[int, tuple[str, Any]]:
        """Return name and content of each episode by number; None for a group that cannot be opened.

        Raises DatasetError.
        """
        if self.is_in_data:
            demos = demonstrations(file, opened)
            if self is ROBOMIMIC:
                return demos
            return {n: (name, None if demo is None else self._episode(demo)) for n, (name, demo) in demos.items()}
        found = {0: opened} if not self.group else _trajectories(file, opened)
        return {n: (f"demo_{n}", None if group is None else self._episode(group)) for n, group in sorted(found.items())}

    def _episode(self, group: Any) -> _Episode:
        above, _, below = self.pictures.partition("{camera}")
        found = members_of(group.get(above.rstrip("/")))
        if below:
            below = below.lstrip("/")
            found = {name: each.get(below) for name, each in found.items() if hasattr(each, "keys") and below in each}
        episode = _Episode(obs=found, actions=group.get(self.actions) if self.actions else None)
        episode.attrs = group.attrs
        return episode


class _Episode(dict[str, Any]):
    attrs: Mapping[str, Any]


_AS_STORED = "read as JPEG files say; some recorders store blue in the place of red"
ROBOMIMIC = Layout(
    "robomimic",
    "data/{demo}",
    "obs/{camera}",
    "actions",
    are_pictures=False,
    without_pictures="robomimic's dataset_states_to_obs.py renders the pictures of a low-dimensional file",
)
ARENA = Layout(
    "IsaacLab-Arena",
    ROBOMIMIC.group,
    "camera_obs/{camera}",
    "actions",
    are_pictures=False,
    fps=50.0,
    skipped=1,  # the last render of the episode before; IsaacLab-Arena's converter to LeRobot leaves it out, too
)
ROBOTWIN = Layout("RoboTwin", "", "observation/{camera}/rgb")
_OTHERS = (
    Layout(
        "RoboMIND",
        "",
        "observations/rgb_images/{camera}",
        fps=30.0,
        colours=f"{_AS_STORED}, as those of RoboMIND's AgileX and Tien Kung robots: look at a frame (--channels bgr)",
    ),
    Layout(
        "ALOHA",
        "",
        "observations/images/{camera}",
        "action",
        fps=50.0,
        colours=f"{_AS_STORED}: look at a frame (--channels bgr)",
    ),
    ROBOTWIN,
)
_MANISKILL = Layout(
    "ManiSkill",
    "traj_{number}",
    "obs/sensor_data/{camera}/rgb",
    "actions",
    fps=20.0,
    without_pictures="python -m mani_skill.trajectory.replay_trajectory -o rgb --save-traj adds them",
)


def layout_of(opened: Any) -> Layout:
    """Return the layout of an open file; robomimic's for an unknown one, whose reader then says what it lacks."""
    for layout in _OTHERS:
        above = members_of(opened.get(layout.pictures.partition("/{camera}")[0]))
        nested = layout is not ROBOTWIN or any(hasattr(each, "keys") and "rgb" in each for each in above.values())
        if above and nested:
            return layout
    if any("camera_obs" in members_of(demo) for demo in members_of(opened.get("data")).values()):
        return ARENA
    return _MANISKILL if "data" not in opened and any(map(_TRAJECTORY.fullmatch, opened)) else ROBOMIMIC


def _trajectories(file: Path, opened: Any) -> dict[int, Any]:
    found: dict[int, Any] = {}
    for name, group in members_of(opened).items():
        if match := _TRAJECTORY.fullmatch(name):
            if int(match[1]) in found:
                raise DatasetError.at(file, "one trajectory of each number", f"{name} again: rename one of them")
            found[int(match[1])] = group
    return found


def task_places(file: Path) -> str:
    """Return where ``task_in`` looks, for messages."""
    return f"attribute or dataset {', '.join(_TASK_NAMES)}, or RoboTwin's instructions/{file.stem}.json"


def task_in(file: Path, opened: Any, episode: Any) -> Any:
    """Return the task of an episode: in attributes, in a dataset, or in RoboTwin's side file; None without one."""
    found = own_task_of(episode)
    for name in _TASK_NAMES:
        found = found or attribute(getattr(episode, "attrs", {}), name) or _one(texts_in(opened.get(name)))
    return found or next(iter(instructions_of(file) if layout_of(opened) is ROBOTWIN else ()), None)


def _one(texts: list[str] | None) -> Any:
    """The only text; all of them if they differ, which no episode can have as its task."""
    different = list(dict.fromkeys(texts or ()))
    return different[0] if len(different) == 1 else different


def instructions_of(file: Path) -> list[str]:
    """Return the sentences of RoboTwin's side file, those of training first; empty without it. Raises DatasetError."""
    side = file.absolute().parent.parent / "instructions" / f"{file.stem}.json"
    if not side.is_file():
        return []
    try:
        told = json.loads(side.read_text(encoding="utf-8"))
        return [str(text) for kind in ("seen", "unseen") for text in told.get(kind, ())]
    except (OSError, ValueError, AttributeError, TypeError, RecursionError) as error:
        raise DatasetError.at(side, 'a JSON object {"seen": [sentences]}', f"{error}: correct or remove it") from error
