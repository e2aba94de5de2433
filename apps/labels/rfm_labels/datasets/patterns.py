# SPDX-License-Identifier: MIT
"""Patterns for files of several cameras below the folders of episodes, such as ``{episode}/videos/{camera}.mp4``.

``{episode}`` stands for any folders and text, ``{camera}`` for text in one name, and ``*`` for text in a folder's or
video's name. In a picture's name ``*`` is the frame's number: ``{episode}/colors/*_{camera}.jpg``.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import Path

from rfm_labels.datasets.dataset import SIGNALS_FOLDER
from rfm_labels.datasets.episodes import Frames
from rfm_labels.datasets.faults import require
from rfm_labels.datasets.pictures_in_order import NUMBER, PICTURE_SUFFIXES, in_natural_order, picture_pattern

_FIELDS = {"*", "{camera}", "{episode}"}
_PART = re.compile(r"(\{\w*\}|\*)")
_MOST_FILES = 10_000  # that a suggestion is made from
_CAMERA = re.compile(r"(cam|color|colour|image|img|rgb|view)", re.IGNORECASE)


def files_of_pattern(root: Path, pattern: str) -> Mapping[str, Mapping[str, Frames]]:
    """Find the files that match a pattern, by episode and camera: a path, or a list of pictures in order.

    Episodes sort by name, with 2 before 10. Raises DatasetError.
    """
    expression, are_pictures = _expression(pattern), Path(pattern).suffix.lower() in PICTURE_SUFFIXES
    found: dict[str, dict[str, dict[tuple[Decimal, ...], Path]]] = {}
    others: list[str] = []
    for name in files_below(root):
        match = expression.fullmatch(name)
        if match is None:
            others.append(name)
            continue
        groups = match.groupdict()
        camera = groups.get("camera") or ("frames" if are_pictures else "video")
        files = found.setdefault(groups["episode"], {}).setdefault(camera, {})
        numbers = tuple(Decimal(text) for key, text in groups.items() if key.startswith("number"))
        same = files.setdefault(numbers, root / name)
        what = "each number once" if are_pictures else "one file of each episode and camera"
        require(root, same == root / name, what, f"{same.relative_to(root)} and {name}: name more of them in --videos")
    got = f"none; it has {', '.join(others[:3]) or 'no files'}{' and others' * (len(others) > 3)}"
    require(root, bool(found), f"files {pattern}", got)
    return {
        episode: {
            camera: [files[number] for number in sorted(files)] if are_pictures else files[()]
            for camera, files in sorted(found[episode].items())
        }
        for episode in in_natural_order(found)
    }


def _expression(pattern: str) -> re.Pattern[str]:
    """Compile a pattern. Raises DatasetError."""
    parts = _PART.split(pattern)
    fields, folders = sorted(parts[1::2]), pattern.rpartition("/")[0]
    is_known = set(fields) <= _FIELDS and fields.count("{episode}") == 1
    is_known = is_known and fields.count("{camera}") < 2 and not {"", "..", "."} & set(pattern.split("/"))
    expected = "{episode} once and {camera} at most once in a path below the folder: '{episode}/videos/{camera}.mp4'"
    unknown = ", ".join(sorted({*fields} - _FIELDS))
    require("videos", is_known, expected, repr(pattern) + (f", with {unknown}" if unknown else ""))
    is_numbered = Path(pattern).suffix.lower() in PICTURE_SUFFIXES
    has_number = not is_numbered or "*" in pattern.removeprefix(folders)
    require("videos", has_number, "a * for the frame's number in a picture's name, as '{episode}/*.jpg'", repr(pattern))
    texts, length = [], 0
    for place, part in enumerate(parts):
        in_name = length >= len(folders)
        number = f"(?P<number{place}>{NUMBER})" if is_numbered and in_name else "[^/]*"
        if place > 1 and not parts[place - 1]:  # directly behind a field, which leaves it all digits
            number = rf"(?<![\d.]){number}"
        known = {"{episode}": "(?P<episode>.+)", "{camera}": "(?P<camera>[^/]+)", "*": number}
        texts.append(known.get(part, re.escape(part)))
        length += len(part)
    return re.compile("".join(texts))


def files_below(root: Path) -> Iterator[str]:
    """Yield all files below a folder as relative paths, without hidden ones and labels."""
    for folder, folders, files in os.walk(root, followlinks=True):
        folders[:] = sorted(name for name in folders if not name.startswith(".") and name != SIGNALS_FOLDER)
        below = Path(folder).relative_to(root)
        yield from ((below / name).as_posix() for name in sorted(files) if not name.startswith("."))


def suggested_pattern(root: Path, example: str) -> str:
    """Return a pattern for the files that are like this one, in the layout of the folder. A guess from the names."""
    suffix, depth = Path(example).suffix, example.count("/")
    alike = (name for name in files_below(root) if Path(name).suffix == suffix and name.count("/") == depth)
    names = [Path(name) for name in itertools.islice(alike, _MOST_FILES)]
    *columns, files = zip(*(name.parts for name in names), strict=True)
    if suffix.lower() in PICTURE_SUFFIXES:
        parts = [picture_pattern([each.name for each in names if each.parent == Path(example).parent])]
    else:
        parts = [(_part([Path(each).stem for each in files], "{camera}") if len(names) > 1 else "{episode}") + suffix]
    is_of_episode = "{episode}" in parts[0]
    for column in reversed(columns):
        if "{episode}" in parts:  # which stands for the folders above it, too
            break
        part = _part(column, "" if "{camera}" in "".join(parts) else "{camera}")
        parts.insert(0, "*" if is_of_episode and part == "{episode}" else part)
    if is_of_episode and "{camera}" not in parts:
        return parts[-1]
    if not is_of_episode and "{episode}" not in parts:
        parts[0] = "{episode}"
    return "/".join(parts)


def _part(values: Sequence[str], camera: str) -> str:
    """What stands for these names, which lie equally deep: the only one, ``camera``, or ``{episode}``."""
    different = set(values)
    without_numbers = {re.sub(r"\d+", "", value) for value in different}
    are_cameras = len(without_numbers) > 1 or all(map(_CAMERA.match, different))
    if len(different) == 1:
        return values[0]
    return camera if camera and are_cameras and len(different) < len(values) else "{episode}"
