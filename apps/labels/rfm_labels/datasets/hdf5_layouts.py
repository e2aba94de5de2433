# SPDX-License-Identifier: MIT
"""HDF5 layouts: where an episode keeps pictures, actions and task. Needs h5py.

A ``Layout`` lists the paths; the reader does not know the layouts.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rfm_client.options import first_names
from rfm_labels.datasets.faults import DatasetError, require, unreadable

DOCUMENTS = ("problem_info", "env_args")  # attributes of ``data`` that hold a JSON object
_SENTENCES = ("language_instruction", "language", "lang")  # keys for the task in problem_info and env_args
_DEFAULT_FPS = 20.0  # robosuite's
_TRAJECTORY = re.compile(r"traj_(\d+)")
_TASK_NAMES = ("language_instruction", "instruction", "task", "language_raw")  # names of datasets and attributes


@contextmanager
def opened_hdf5(file: Path) -> Iterator[Any]:
    """Open a file to read. Raises DatasetError if it is unreadable, locked or damaged, ImportError without h5py."""
    try:
        import h5py
    except ImportError as error:
        raise ImportError('HDF5 files need h5py: pip install ./client "./apps/labels[hdf5]"') from error
    if file.exists() and not file.is_file():  # opening a pipe would block for ever
        raise DatasetError.at(file, "an HDF5 file", "a folder, a pipe, a socket or a device")
    try:
        opened = h5py.File(file, "r")
    except BlockingIOError as error:
        expected = "a file that no other program has open for writing"
        raise DatasetError.at(file, expected, "an open one: close it there, and run the same command") from error
    except OSError as error:
        raise unreadable(file, "an HDF5 file", error) from error
    with opened:
        try:
            yield opened
        except (OSError, RuntimeError, KeyError) as error:  # h5py raises these for damaged data
            raise DatasetError.at(file, "an undamaged HDF5 file", error) from error


def members_of(group: Any) -> Mapping[str, Any]:
    """Return a group's members by name, None for a member that cannot be opened; empty if it is not a group."""
    members = group.items() if hasattr(group, "keys") else ()
    return {name.decode(errors="replace") if isinstance(name, bytes) else name: member for name, member in members}


def filter_keys(opened: Any) -> Mapping[str, Sequence[int]]:
    """Return the demonstration numbers in each ``mask`` dataset with names of demonstrations."""
    found: dict[str, Sequence[int]] = {}
    for key, stored in members_of(opened.get("mask")).items():
        texts = texts_in(stored)
        names = [re.fullmatch(r"demo_(0|[1-9]\d*)", text) for text in texts or ()]
        if texts is not None and None not in names:
            found[key] = sorted({int(name[1]) for name in names if name})
    return found


def texts_in(stored: Any) -> list[str] | None:
    """Read the texts in a dataset; None if it holds something else or cannot be read."""
    if getattr(stored, "shape", None) is None:
        return None
    try:
        values = np.ravel(stored[()]).tolist()
    except (OSError, RuntimeError, TypeError, ValueError):
        return None
    return [value.decode(errors="replace") if isinstance(value, bytes) else str(value) for value in values]


def is_of_libero(attributes: Mapping[str, Any]) -> bool:
    """True if the attributes on ``data`` are LIBERO's."""
    env_names = [attribute(attributes, "env_name"), document(attributes, "env_args").get("env_name")]
    env_names.append(attribute(attributes, "tag"))
    has_problem = not {"problem_name", "language_instruction"}.isdisjoint(document(attributes, "problem_info"))
    is_named = any("libero" in str(name).lower() for name in env_names)
    return has_problem or is_named or "bddl_file_name" in attributes


def fps_of(attributes: Mapping[str, Any]) -> float:
    """Return the frame rate in Hz: robosuite's control frequency, else its default."""
    env_kwargs = document(attributes, "env_args").get("env_kwargs")
    fps = env_kwargs.get("control_freq") if isinstance(env_kwargs, dict) else None
    return float(fps) if isinstance(fps, int | float) and 0 < fps < 1000 else _DEFAULT_FPS


def document(attributes: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Parse the JSON object in an attribute; empty if there is none."""
    try:
        found = json.loads(attribute(attributes, name))
    except (ValueError, TypeError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def unread_documents(attributes: Mapping[str, Any]) -> list[str]:
    """Name the attributes that should hold a JSON object but do not."""
    broken = [name for name in DOCUMENTS if name in attributes and not document(attributes, name)]
    return [name for name in broken if str(attribute(attributes, name)).strip() not in ("", "{}")]


def attribute(attributes: Mapping[str, Any], name: str) -> Any:
    """Read an attribute: bytes become text, an array becomes a list, a single element stands alone.

    Return None for an attribute that is missing, empty or unreadable.
    """
    try:
        value = attributes.get(name)
    except (OSError, RuntimeError, TypeError, ValueError):
        return None
    if isinstance(value, np.ndarray):
        value = value.item() if value.size == 1 else value.tolist()
    if hasattr(value, "dtype") and getattr(value, "shape", ()) is None:  # HDF5's null
        return None
    return value.decode(errors="replace") if isinstance(value, bytes) else value


@dataclass(frozen=True)
class Layout:
    """The paths in a file with this layout.

    group: path to an episode; empty: the file is one episode
    pictures: path to a camera, within the group
    actions: path within the group; empty: not compared with the frames
    are_pictures: True: whatever is at ``pictures`` is a camera; False: the observations also hold other arrays
    fps: the writer's default; None: in the attributes
    skipped: how many pictures come before the first frame
    without_pictures: remedy for a file without pictures
    colours: note on the channel order in encoded frames
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
        """Return the path to the ``demo_<number>`` group; empty: the file."""
        return self.group.format(demo=demo, number=demo.removeprefix("demo_"))

    def path_of(self, demo: str, camera: str) -> str:
        """Return the path to a camera's frames."""
        return f"{self.group_of(demo)}/{self.pictures.format(camera=camera)}".lstrip("/")

    def cameras_at(self, demo: str) -> str:
        """Return the path above the cameras."""
        return self.path_of(demo, "{camera}").partition("{camera}")[0].rstrip("/")

    def episodes(self, file: Path, opened: Any) -> dict[int, tuple[str, Any]]:
        """Return each episode's name and group by number; None for a group that cannot be opened.

        Raises DatasetError if there is none, or two share a number.
        """
        above, _, pattern = self.group.rpartition("/")
        if not pattern:
            return {0: ("demo_0", opened)}
        name_of, members = re.compile(pattern.format(demo=r"demo_(\d+)", number=r"(\d+)")), members_of(opened)
        members = members_of(members.get(above)) if above else members
        found: dict[int, tuple[str, Any]] = {}
        where, got = f"{file}: {above}".removesuffix(": "), first_names(members)
        for name, group in members.items():
            if match := name_of.fullmatch(name):
                number = int(match[1])
                twice = f"{found.get(number, ('', None))[0]} and {name}: rename one of them"
                require(where, number not in found, "one demonstration of each number", twice)
                found[number] = name, group
        got = got or f"none: the file holds {first_names(members_of(opened)) or 'nothing'}"
        require(where, bool(found), "demo_0, demo_1 and so on", got)
        return {
            number: (f"demo_{number}" if not above else name, group) for number, (name, group) in sorted(found.items())
        }

    def observations(self, group: Any) -> dict[str, Any]:
        """Return an episode's observations by name; None for one that cannot be opened or that NumPy does not know."""
        above, _, below = self.pictures.partition("{camera}")
        found = members_of(group.get(above.rstrip("/")) if hasattr(group, "keys") else None)
        if below := below.lstrip("/"):
            found = {name: each.get(below) for name, each in found.items() if hasattr(each, "keys") and below in each}
        return {name: value if _is_known(value) else None for name, value in found.items()}


def _is_known(value: Any) -> bool:
    """True for a group, or an array with numbers or texts that NumPy knows."""
    try:
        return hasattr(value, "keys") or (getattr(value, "shape", None) is not None and bool(value.dtype.kind))
    except (TypeError, OSError, RuntimeError):
        return False


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
    skipped=1,  # the previous episode's last render; IsaacLab-Arena's converter to LeRobot also drops it
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
    """Detect an open file's layout; robomimic's if unknown, whose reader then says what is missing."""
    for layout in _OTHERS:
        above = members_of(opened.get(layout.pictures.partition("/{camera}")[0]))
        nested = layout is not ROBOTWIN or any(hasattr(each, "keys") and "rgb" in each for each in above.values())
        if above and nested:
            return layout
    if any("camera_obs" in members_of(demo) for demo in members_of(opened.get("data")).values()):
        return ARENA
    return _MANISKILL if "data" not in opened and any(map(_TRAJECTORY.fullmatch, opened)) else ROBOMIMIC


def task_places(file: Path, layout: Layout, broken: Sequence[str]) -> str:
    """Return where ``task_of`` looks, for messages. broken: as ``unread_documents`` names them"""
    if layout.is_in_data:
        documents = [name + " (no JSON object)" * (name in broken) for name in DOCUMENTS]
        return f"ep_meta, or data: {' or '.join(documents)}"
    return f"attribute or dataset {', '.join(_TASK_NAMES)}, or RoboTwin's instructions/{file.stem}.json"


def task_of(file: Path, opened: Any, episode: Any, layout: Layout) -> Any:
    """Read an episode's task; None without one.

    First from its attributes, as robomimic does (``ep_meta``); then from those of ``data``, or for an episode outside
    of ``data`` from other attributes, a dataset, or RoboTwin's side file.
    """
    attributes = getattr(episode, "attrs", {})
    stored = document(attributes, "ep_meta")
    found = next((stored[key] for key in _SENTENCES if stored.get(key)), None)
    found = found or next((attribute(attributes, key) for key in _SENTENCES if key in attributes), None)
    if layout.is_in_data:
        documents = [document(opened["data"].attrs, name) for name in DOCUMENTS]
        return found or next((each[key] for each in documents for key in _SENTENCES if each.get(key)), None)
    for name in _TASK_NAMES:
        found = found or attribute(attributes, name) or _one(texts_in(opened.get(name)))
    return found or next(iter(instructions_of(file) if layout is ROBOTWIN else ()), None)


def _one(texts: list[str] | None) -> Any:
    """The only text; all of them if they differ, which no episode accepts as a task."""
    different = list(dict.fromkeys(texts or ()))
    return different[0] if len(different) == 1 else different


def instructions_of(file: Path) -> list[str]:
    """Read the sentences in RoboTwin's side file, training ones first; empty without it. Raises DatasetError."""
    side = file.absolute().parent.parent / "instructions" / f"{file.stem}.json"
    if not side.is_file():
        return []
    try:
        content = json.loads(side.read_text(encoding="utf-8"))
        return [str(text) for kind in ("seen", "unseen") for text in content.get(kind, ())]
    except (OSError, ValueError, AttributeError, TypeError, RecursionError) as error:
        raise DatasetError.at(side, 'a JSON object {"seen": [sentences]}', f"{error}: correct or remove it") from error
