# SPDX-License-Identifier: MIT
"""Order the pictures of an episode by the numbers in file names: counts or times (``-1``, ``0.25``, ``2e-05``).

In a pattern of names, ``*`` stands for a number: ``*_color_0.jpg``.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

from rfm_labels.datasets.faults import DatasetError, require

_NOT_IN_A_WORD = r"(?<![^\W_])"  # behind a letter or a digit, - and . separate: frame-1.png, frame.1.png, 2026-11-26
_NUMBER = re.compile(
    rf"((?:{_NOT_IN_A_WORD}-)?"
    rf"(?:(?<!\d\.)\d+\.\d+(?!\.?\d)|{_NOT_IN_A_WORD}\.\d+|\d+)"  # 1.2.10 has no decimals
    r"(?:[eE][+-]\d+(?![^\W_]))?)"
)
_LETTERS = 2  # minimum letters of a word before a camera number; a time may hold one letter, as in 20261126T123000
_EXAMPLES = 3  # kinds of names in a message


def is_pattern(path: Path) -> bool:
    """True if the last part of a path is a pattern of file names."""
    return "*" in path.name


def matching(pattern: str, files: Sequence[str]) -> list[str]:
    """Return the file names that a pattern stands for."""
    name = re.compile(_NUMBER.pattern.join(map(re.escape, pattern.split("*"))))
    return list(filter(name.fullmatch, files))


@dataclass(frozen=True)
class _Name:
    """A file name split into text and numbers. words: the texts, one more than numbers, and the format"""

    file: str
    words: tuple[str, ...]
    digits: tuple[str, ...]
    numbers: tuple[Decimal, ...]

    @classmethod
    def of(cls, file: str) -> _Name:
        parts = _NUMBER.split(Path(file).stem)
        digits = tuple(parts[1::2])
        form = Path(file).suffix.lower().replace("jpeg", "jpg")
        return cls(file, (*parts[::2], form), digits, tuple(map(Decimal, digits)))

    def kind(self, place: int | None) -> str:
        """The name with ``*`` for all numbers but the one at ``place``."""
        shown = ["*" if number != place else digits for number, digits in enumerate(self.digits)]
        parts = [self.words[0], *(part for pair in zip(shown, self.words[1:-1], strict=True) for part in pair)]
        return "".join(parts) + Path(self.file).suffix


def in_order_of_numbers(folder: Path, files: Sequence[str]) -> list[str]:
    """Return an episode's file names in order.

    Raises DatasetError for several kinds of names, such as those of several cameras, or for a repeated number.
    """
    names = sorted(map(_Name.of, files), key=lambda name: (name.numbers, name.file))
    if len({name.words for name in names}) > 1:
        raise _several_kinds(folder, names, None)
    for before, name in itertools.pairwise(names):
        got = f"{before.file} and {name.file}: leave the episode out (--episodes)"
        require(folder, before.numbers != name.numbers, "each number once", got)
    places = range(len(names[0].numbers)) if names else ()
    num_cameras = {place: _num_cameras(names, place) for place in places}
    of_cameras = [place for place in places if num_cameras[place]]
    if of_cameras:
        raise _several_kinds(folder, names, min(of_cameras, key=lambda place: num_cameras[place]))
    return [name.file for name in names]


def _num_cameras(names: Sequence[_Name], place: int) -> int:
    """Number of cameras that the numbers at a place count; 0 if they count frames.

    Cameras have the same frames, so names repeat without a camera number. Times such as ``12_500`` (s, ms) may repeat
    by chance, so either all names must repeat, or the number must belong to a word, as in ``cam1_0001``.
    """
    others = Counter(name.numbers[:place] + name.numbers[place + 1 :] for name in names)
    values = {name.numbers[place] for name in names}
    word = names[0].words[place][-_LETTERS:]
    is_in_word = len(word) == _LETTERS and word.isalpha()
    repeats = 1 < len(others) < len(names)
    return len(values) if repeats and (is_in_word or len(others) * len(values) == len(names)) else 0


def _several_kinds(folder: Path, names: Sequence[_Name], place: int | None) -> DatasetError:
    """The error for several kinds of names."""
    kinds: Mapping[str, int] = Counter(name.kind(place) for name in names)
    shortest = sorted(kinds, key=lambda kind: (len(kind), kind))
    told = " and ".join(f"{kind} ({kinds[kind]})" for kind in shortest[:_EXAMPLES])
    if max(kinds.values()) == 1:
        remedy = "copy them to a folder of their own, as 0.png and 1.png"
        return DatasetError.at(folder, "names that differ in a number", f"{told}: {remedy}")
    got = f"{told}: list those of one camera in tasks.csv, as {folder.name}/{shortest[0]}"
    return DatasetError.at(folder, "pictures of one camera, whose names differ in a number", got)
