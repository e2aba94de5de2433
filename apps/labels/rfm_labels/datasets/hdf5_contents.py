# SPDX-License-Identifier: MIT
"""Read an HDF5 file: demonstrations, filter keys and attributes. Needs h5py."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rfm_client.options import first_names
from rfm_labels.datasets.faults import DatasetError, require, unreadable

DOCUMENTS = ("problem_info", "env_args")  # attributes of ``data`` with a JSON object

_DEMO = re.compile(r"demo_(\d+)")
_SENTENCES = ("language_instruction", "language", "lang")  # keys of the task in problem_info and env_args
_DEFAULT_FPS = 20.0  # robosuite's


@contextmanager
def opened_hdf5(file: Path) -> Iterator[Any]:
    """Open a file to read. Raises DatasetError if it is unreadable, locked or damaged, ImportError without h5py."""
    try:
        import h5py
    except ImportError as error:
        raise ImportError('HDF5 files need h5py: pip install ./client "./apps/labels[hdf5]"') from error
    if file.exists() and not file.is_file():  # opening a pipe would wait for ever
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
        except (OSError, RuntimeError, KeyError) as error:  # h5py's, of damaged data
            raise DatasetError.at(file, "an undamaged HDF5 file", error) from error


def demonstrations(file: Path, opened: Any) -> dict[int, tuple[str, Any]]:
    """Return the names and groups of demonstrations by number; None for a group that cannot be opened.

    Raises DatasetError for no demonstration, or two demonstrations with one number.
    """
    group = opened.get("data")
    members = members_of(group)
    demos: dict[int, tuple[str, Any]] = {}
    for name, content in members.items():
        if match := _DEMO.fullmatch(name):
            number = int(match[1])
            got = f"{demos.get(number, ('', None))[0]} and {name}: rename one of them"
            require(f"{file}: data", number not in demos, "one demonstration of each number", got)
            demos[number] = name, content
    got = first_names(members) or f"none: the file holds {first_names(members_of(opened)) or 'nothing'}"
    require(f"{file}: data", bool(demos), "demo_0, demo_1 and so on", got)
    return dict(sorted(demos.items()))


def members_of(group: Any) -> Mapping[str, Any]:
    """Return a group's members by name, None for a member that cannot be opened; empty if it is not a group."""
    members = group.items() if hasattr(group, "keys") else ()
    return {name.decode(errors="replace") if isinstance(name, bytes) else name: member for name, member in members}


def filter_keys(opened: Any, names: Mapping[int, str]) -> tuple[Mapping[str, Sequence[int]], Sequence[str]]:
    """Return the demonstration numbers in each dataset of ``mask``, and a note on each dataset with other contents.

    names: names of the demonstrations by number
    """
    group, numbers = opened.get("mask"), {name: number for number, name in names.items()}
    found: dict[str, Sequence[int]] = {}
    notes = ["left out: mask: expected a group"] if "mask" in opened and not hasattr(group, "keys") else []
    for key, stored in members_of(group).items():
        told = texts_in(stored)
        known = [numbers.get(name, _missing_number(name, names)) for name in told or ()]
        if told is not None and None not in known:
            found[key] = sorted(number for number in known if number is not None)
        else:
            others = [name for name, number in zip(told or (), known, strict=True) if number is None]
            notes.append(
                f"left out: mask/{key}: expected names of demonstrations, got {first_names(others) or 'no text'}"
            )
    return found, notes


def unread(opened: Any, names: Iterable[str]) -> list[str]:
    """Return a line that lists all unread groups; empty if there are none. names: demonstrations"""
    read = set(names)
    others = [f"data/{name}" for name in members_of(opened["data"]) if name not in read]
    others += [name for name in members_of(opened) if name not in ("data", "mask")]
    return [f"left out: {first_names(others)}: demonstrations are data/demo_<number>"] if others else []


def texts_in(stored: Any) -> list[str] | None:
    """Return the texts in a dataset; None if it holds something else or cannot be read."""
    if getattr(stored, "shape", None) is None:
        return None
    try:
        values = np.ravel(stored[()]).tolist()
    except (OSError, RuntimeError, TypeError, ValueError):
        return None
    return [value.decode(errors="replace") if isinstance(value, bytes) else str(value) for value in values]


def _missing_number(name: str, names: Mapping[int, str]) -> int | None:
    """The number of a demonstration missing from the file; None for another name."""
    match = _DEMO.fullmatch(name)
    return int(match[1]) if match and int(match[1]) not in names else None


def own_task_of(demo: Any) -> Any:
    """Return the task in a demonstration's ``ep_meta``, as robomimic reads it, or in an attribute; None without one."""
    attributes = getattr(demo, "attrs", {})
    stored = document(attributes, "ep_meta")
    own = next((stored[key] for key in _SENTENCES if stored.get(key)), None)
    return own or next((attribute(attributes, key) for key in _SENTENCES if key in attributes), None)


def task_of(attributes: Mapping[str, Any]) -> Any:
    """Return the task of all demonstrations from the attributes of ``data``; None if there is none."""
    documents = (document(attributes, name) for name in DOCUMENTS)
    return next((found[key] for found in documents for key in _SENTENCES if found.get(key)), None)


def is_of_libero(attributes: Mapping[str, Any]) -> bool:
    """True if the attributes of ``data`` are LIBERO's."""
    env_names = [attribute(attributes, "env_name"), document(attributes, "env_args").get("env_name")]
    env_names.append(attribute(attributes, "tag"))
    has_problem = not {"problem_name", "language_instruction"}.isdisjoint(document(attributes, "problem_info"))
    is_named = any("libero" in str(name).lower() for name in env_names)
    return has_problem or is_named or "bddl_file_name" in attributes


def fps_of(attributes: Mapping[str, Any]) -> float:
    """Return the frames per second: robosuite's control frequency, else its default."""
    told = document(attributes, "env_args").get("env_kwargs")
    fps = told.get("control_freq") if isinstance(told, dict) else None
    return float(fps) if isinstance(fps, int | float) and 0 < fps < 1000 else _DEFAULT_FPS


def document(attributes: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Return the JSON object in an attribute; empty if there is none."""
    try:
        found = json.loads(attribute(attributes, name))
    except (ValueError, TypeError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def unread_documents(attributes: Mapping[str, Any]) -> list[str]:
    """Return the names of attributes that should hold a JSON object but do not."""
    broken = [name for name in DOCUMENTS if name in attributes and not document(attributes, name)]
    return [name for name in broken if str(attribute(attributes, name)).strip() not in ("", "{}")]


def attribute(attributes: Mapping[str, Any], name: str) -> Any:
    """Return an attribute, with bytes as text, an array as a list, and a single element without the list.

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
