# SPDX-License-Identifier: MIT
"""Pictures that are an episode's frames, in the order of the numbers in their names: counts or times.

``-1``, ``0.25`` and ``2e-05`` are numbers. Pictures of several cameras in one folder are an error.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

from rfm_client.options import counted, first_names
from rfm_labels.datasets.faults import DatasetError, require

_NOT_IN_A_WORD = r"(?<![^\W_])"  # after a letter or digit, - and . are separators: frame-1.png, frame.1.png, 2026-11-26
NUMBER = (
    rf"(?:{_NOT_IN_A_WORD}-)?"
    rf"(?:(?<!\d\.)\d+\.\d+(?!\.?\d)|{_NOT_IN_A_WORD}\.\d+|\d+)"  # 1.2.10 has no decimals
    r"(?:[eE][+-]\d+(?![^\W_]))?"
)
_NUMBER = re.compile(f"({NUMBER})")
_LETTERS = 2  # minimum word length before a camera number; a time may contain one letter, as in 20261126T123000
_EXAMPLES = 3  # kinds of names in a message
_SEPARATORS = "_-. "
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
_LEAVE_OUT = "leave it out (--episodes)"


@dataclass(frozen=True)
class _Name:
    """A file name split into text and numbers. words: the texts around the numbers, then the format."""

    file: str
    words: tuple[str, ...]
    numbers: tuple[Decimal, ...]

    @classmethod
    def of(cls, file: str) -> _Name:
        parts = _NUMBER.split(Path(file).stem)
        form = Path(file).suffix.lower().replace("jpeg", "jpg")
        return cls(file, (*parts[::2], form), tuple(map(Decimal, parts[1::2])))


def in_order_of_numbers(folder: Path, files: Sequence[str]) -> list[str]:
    """Sort an episode's file names by their numbers.

    Raises DatasetError for a repeated number, or different kinds of names, such as from several cameras.
    """
    names = sorted(map(_Name.of, files), key=lambda name: (name.numbers, name.file))
    if len({name.words for name in names}) > 1:
        raise _several_kinds(folder, files)
    for before, name in itertools.pairwise(names):
        got = f"{before.file} and {name.file}: leave the episode out (--episodes)"
        require(folder, before.numbers != name.numbers, "each number once", got)
    if any(_counts_cameras(names, place) for place in range(len(names[0].numbers) if names else 0)):
        raise _several_kinds(folder, files)
    return [name.file for name in names]


def missing_numbers(files: Sequence[str]) -> str:
    """Say where pictures, in order, skip numbers; empty: nowhere, or their numbers have no usual step."""
    names = [_Name.of(file) for file in files]
    counts = [column for column in zip(*(name.numbers for name in names), strict=False) if len(set(column)) > 1]
    if len(counts) != 1 or len({name.words for name in names}) > 1:
        return ""
    steps = [after - before for before, after in itertools.pairwise(counts[0])]
    usual, how_often = Counter(sorted(steps)).most_common(1)[0]
    # A step is a gap from 1.5 times the usual one on: regular times in ms also differ, by 33 and 34 at 30 Hz.
    gaps = [pair for pair, step in zip(itertools.pairwise(files), steps, strict=True) if 2 * step >= 3 * usual]
    if not gaps or usual <= 0 or 2 * how_often < len(steps):
        return ""
    more = f", and {counted(len(gaps) - 1, 'more such gap')}" if len(gaps) > 1 else ""
    return f"no picture between {' and '.join(gaps[0])}{more}; were frames dropped while recording?"


def _counts_cameras(names: Sequence[_Name], place: int) -> bool:
    """True if the numbers at a place count cameras, and not frames.

    All cameras have the same frames, so names repeat once the camera number is removed. Times such as ``12_500`` (s,
    ms) may repeat by chance, so either all names must repeat, or the number must belong to a word, as in ``cam1_0001``.
    """
    others = Counter(name.numbers[:place] + name.numbers[place + 1 :] for name in names)
    values = {name.numbers[place] for name in names}
    word = names[0].words[place][-_LETTERS:]
    is_in_word = len(word) == _LETTERS and word.isalpha()
    return 1 < len(others) < len(names) and (is_in_word or len(others) * len(values) == len(names))


def _several_kinds(folder: Path, files: Sequence[str]) -> DatasetError:
    """The error for several kinds of names."""
    kinds = Counter(_NUMBER.sub("*", Path(file).stem) + Path(file).suffix for file in files)
    examples = " and ".join(f"{kind} ({count})" for kind, count in kinds.most_common(_EXAMPLES))
    if max(kinds.values()) == 1:
        remedy = "copy them to a folder of their own, as 0.png and 1.png"
        return DatasetError.at(folder, "names that differ in a number", f"{examples}: {remedy}")
    got = f"{examples}: name the frame's number and the camera, as --videos '{{episode}}/{picture_pattern(files)}'"
    return DatasetError.at(folder, "pictures of one camera, whose names differ in a number", got)


def picture_pattern(files: Sequence[str]) -> str:
    """Return a pattern for an episode's pictures: ``*`` for the frame's number, ``{camera}`` for names that differ."""
    suffix, _ = Counter(Path(file).suffix for file in files).most_common(1)[0]
    split = [_NUMBER.split(Path(file).stem) for file in files if Path(file).suffix == suffix]
    length, _ = Counter(map(len, split)).most_common(1)[0]
    split = [parts for parts in split if len(parts) == length]
    place = max(range(1, length, 2), key=lambda place: len({parts[place] for parts in split}), default=0)
    before, after = (
        Counter("".join(each[:place]) for each in split),
        Counter("".join(each[place + 1 :]) for each in split),
    )
    start, end = before.most_common(1)[0][0], after.most_common(1)[0][0]
    if len(before) > 1 and len(after) == 1 and "" not in before:
        start = "{camera}" + start[len(start.rstrip(_SEPARATORS)) :]
    elif len(after) > 1 and len(before) == 1 and "" not in after:
        end = end[: len(end) - len(end.lstrip(_SEPARATORS))] + "{camera}"
    return f"{start}*{end}{suffix}"


def in_natural_order(names: Iterable[str]) -> list[str]:
    """Sort episode names, comparing numbers as integers: ``2`` before ``10``, ``1.2`` before ``1.10``.

    ``in_order_of_numbers`` sorts frames, whose numbers may be times.
    """

    def key(name: str) -> tuple[list[tuple[int, str]], str]:
        parts = re.split(r"(\d+)", name)
        return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], name

    return sorted(names, key=key)


def is_picture(file: Path) -> bool:
    """True for a PNG or JPEG file, by suffix; False for a hidden one."""
    return file.suffix.lower() in PICTURE_SUFFIXES and not file.name.startswith(".") and file.is_file()


def pictures_in(folder: Path) -> list[Path]:
    """List the pictures in an episode's folder in order. Raises DatasetError if there are none, or several kinds."""
    try:
        found = [each for each in folder.iterdir() if not each.name.startswith(".")]
    except OSError as error:
        alike = [each.name for each in folder.parent.glob("*") if each.stem == folder.name]
        got = f"none: write the whole name, {first_names(sorted(alike))}" if alike else error.strerror
        raise DatasetError.at(folder, "a folder of PNG or JPEG files", got) from error
    names = [each.name for each in found if is_picture(each)]
    folders = in_natural_order([each.name for each in found if each.is_dir()])
    names_there = first_names(sorted(each.name for each in found), 3)
    got = f"{names_there}: name videos by a pattern (--videos), or {_LEAVE_OUT}"
    got = got if found else f"an empty folder: {_LEAVE_OUT}"
    if folders:
        remedy = "if they are cameras, --videos '{episode}/{camera}/*.png' names their pictures"
        got = f"the folders {', '.join(folders[:3])}: {remedy}; or {_LEAVE_OUT}"
    require(folder, bool(names), "PNG or JPEG files", got)
    return [folder / name for name in in_order_of_numbers(folder, names)]
