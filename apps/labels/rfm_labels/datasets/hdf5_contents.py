# SPDX-License-Identifier: MIT
"""What HDF5 files of robomimic's layout hold: demonstrations, observations, tasks, filter keys. Needs h5py."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from rfm_client.options import first_names
from rfm_labels.datasets.dataset import LEAST_SIZE_PX
from rfm_labels.datasets.faults import DatasetError, require, unreadable
from rfm_labels.datasets.stored_files import colours_fault

DOCUMENTS = ("problem_info", "env_args")  # attributes of ``data`` that hold a JSON object
_SENTENCES = ("language_instruction", "language", "lang")  # keys for the task in problem_info and env_args
_DEFAULT_FPS = 20.0  # robosuite's
_STARTS = (b"\xff\xd8\xff", b"\x89PNG")  # first bytes in JPEG and PNG files


@contextmanager
def opened_hdf5(file: Path) -> Iterator[Any]:
    """Open a file to read. Raises DatasetError if it is unreadable, locked or damaged, ImportError without h5py."""
    try:
        import h5py
    except ImportError as error:
        raise ImportError(f'HDF5 files need h5py: {error}: pip install ./client "./apps/labels[hdf5]"') from error
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
        try:
            values = np.ravel(stored[()]).tolist()
        except (OSError, RuntimeError, TypeError, ValueError):
            continue
        texts = [value.decode(errors="replace") if isinstance(value, bytes) else str(value) for value in values]
        names = [re.fullmatch(r"demo_(0|[1-9]\d*)", text) for text in texts]
        if None not in names:
            found[key] = sorted({int(name[1]) for name in names if name})
    return found


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


def demonstrations(file: Path, opened: Any) -> dict[int, tuple[str, Any]]:
    """Return each demonstration's name and group by number; None for a group that cannot be opened.

    Raises DatasetError if there is none, or two share a number.
    """
    found: dict[int, tuple[str, Any]] = {}
    members = members_of(opened.get("data"))
    for name, group in members.items():
        if match := re.fullmatch(r"demo_(\d+)", name):
            number = int(match[1])
            twice = f"{found.get(number, ('', None))[0]} and {name}: rename one of them"
            require(f"{file}: data", number not in found, "one demonstration of each number", twice)
            found[number] = name, group
    top = first_names(members_of(opened)) or "nothing"
    others = "a reader opens other layouts, as those of ALOHA, ManiSkill, Minari and RoboTwin in examples/readers"
    got = first_names(members) or f"none: the file holds {top}; {others}"
    require(f"{file}: data", bool(found), "demo_0, demo_1 and so on", got)
    return dict(sorted(found.items()))


def observations(group: Any, folder: str) -> dict[str, Any]:
    """Return a demonstration's observations by name; None for one that cannot be opened or that NumPy does not know."""
    found = members_of(group.get(folder) if hasattr(group, "keys") else None)
    known: dict[str, Any] = dict.fromkeys(found)
    for name, value in found.items():
        with suppress(TypeError, OSError, RuntimeError):
            if hasattr(value, "keys") or (getattr(value, "shape", None) is not None and value.dtype.kind):
                known[name] = value
    return known


def task_of(opened: Any, demo: Any) -> Any:
    """Read a demonstration's task, as robomimic does: its own, else that of ``data``; None without one."""
    attributes = getattr(demo, "attrs", {})
    stored = document(attributes, "ep_meta")
    found = next((stored[key] for key in _SENTENCES if stored.get(key)), None)
    found = found or next((attribute(attributes, key) for key in _SENTENCES if key in attributes), None)
    documents = [document(opened["data"].attrs, name) for name in DOCUMENTS]
    return found or next((each[key] for each in documents for key in _SENTENCES if each.get(key)), None)


def form_of(value: Any) -> str:
    """Describe type and shape, for messages."""
    if value is None:
        return "(unreadable)"
    return f"{value.dtype} {list(value.shape)}" if hasattr(value, "shape") else "(a group)"


def fault_of(value: Any) -> str:
    """Return why an observation is not a camera's frames; empty if it is."""
    if not hasattr(value, "shape"):
        return "a group: expected its pictures one level up"
    if value.is_virtual:  # h5py would show zeros for frames missing in another file
        return "a virtual dataset: copy its frames into the file"
    if _are_files(value):
        return "JPEG or PNG files: a reader decodes them (--reader; examples/readers/aloha.py)"
    return colours_fault(value)


def may_be_picture(value: Any) -> bool:
    """True if an observation may be pictures, even in an unsupported form."""
    if value is None:  # it may have been one
        return True
    if not hasattr(value, "shape"):
        return bool(value.visititems(lambda _, each: (hasattr(each, "shape") and may_be_picture(each)) or None))
    if len(value.shape) == 3:
        return all(size >= LEAST_SIZE_PX for size in value.shape[1:])
    return len(value.shape) > 3 or _are_files(value)


def _are_files(value: Any) -> bool:
    """True for an array of picture files: the first begins like one."""
    kinds = {1: "OSV", 2: "u"}
    if not value.shape or not value.shape[0] or value.dtype.kind not in kinds.get(len(value.shape), ""):
        return False
    try:
        return np.asarray(value[0]).tobytes().startswith(_STARTS)
    except (OSError, RuntimeError):
        return False
