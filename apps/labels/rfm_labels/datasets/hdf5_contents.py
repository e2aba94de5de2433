# SPDX-License-Identifier: MIT
"""Read the demonstrations and filter keys of an HDF5 file, and list everything else. Needs h5py."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rfm_client.options import first_names
from rfm_labels.datasets.hdf5_layouts import foreign_layout
from rfm_labels.datasets.protocol import DatasetError, require

_DEMO = re.compile(r"demo_(\d+)")


@contextmanager
def opened_hdf5(file: Path) -> Iterator[Any]:
    """Open a file to read. Raises DatasetError if it is unreadable, locked or damaged, ImportError without h5py."""
    try:
        import h5py
    except ImportError as error:
        raise ImportError('HDF5 files need h5py: pip install ./client "./apps/labels[hdf5]"') from error
    try:
        opened = h5py.File(file, "r")
    except BlockingIOError as error:
        expected = "a file that no other program has open for writing"
        raise DatasetError.at(file, expected, "an open one: close it there, and run the same command") from error
    except OSError as error:
        raise DatasetError.at(file, "an HDF5 file", error) from error
    with opened:
        try:
            yield opened
        except (OSError, RuntimeError, KeyError) as error:  # h5py's, of damaged data
            raise DatasetError.at(file, "an undamaged HDF5 file", error) from error


def demonstrations(file: Path, opened: Any) -> dict[int, tuple[str, Any]]:
    """Return the names and groups of demonstrations by number; None for a group that cannot be opened.

    Raises DatasetError for another layout, no demonstration, or two demonstrations with one number.
    """
    layout = foreign_layout(opened)
    require(file, layout is None, "data/demo_0/obs/<camera>", layout)
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
        told = _texts(stored)
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


def _texts(stored: Any) -> list[str] | None:
    """The texts in a dataset; None if it holds something else or cannot be read."""
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
