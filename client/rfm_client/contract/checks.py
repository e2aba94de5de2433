# SPDX-License-Identifier: MIT
"""Validate callers' values, numbers, tasks and files; words for messages."""

from __future__ import annotations

import math
import numbers
from collections.abc import Collection
from pathlib import Path
from typing import Any

from rfm_client.contract.errors import InvalidValueError, LocatedError

_PLACEHOLDERS = {"none", "null", "nan", "n/a", "n.a.", "na", "todo", "tbd", "unknown"}  # stand-ins for a missing task
_LFS_POINTER = b"version https://git-lfs"  # how a pointer file begins


def require(
    where: object, condition: bool, expected: str, got: object, error: type[LocatedError] = InvalidValueError
) -> None:
    """Raise ``error`` unless the condition holds."""
    if not condition:
        raise error.at(where, expected, got)


def first_names(names: Collection[object], most: int = 5) -> str:
    """Return the first names and how many more there are."""
    more = len(names) - most
    return ", ".join(map(str, list(names)[:most])) + (f" and {more} more" if more > 0 else "")


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: ``1 video``, ``2 videos``."""
    ending = "" if number == 1 else "es" if noun.endswith("s") else "s"
    return f"{number} {noun}{ending}"


def git_lfs_pointer(content: Path | bytes) -> str:
    """Return a message about a file cloned without git-lfs; empty for all other files.

    content: the file, or its first bytes
    """
    if isinstance(content, Path):
        with content.open("rb") as file:
            content = file.read(len(_LFS_POINTER))
    is_pointer = content.startswith(_LFS_POINTER)
    return "Git LFS's note of where it is; `git lfs pull` fetches it" if is_pointer else ""


def is_blank(task: Any) -> bool:
    """True if a task has no value, letter or digit, or is a placeholder such as ``N/A``."""
    if isinstance(task, str):
        text = task.strip().casefold()
        return text in _PLACEHOLDERS or not any(map(str.isalnum, text))
    return not task or task != task  # NaN differs from itself


def checked_count(
    where: str, value: Any, *, least: int | None = 1, error: type[LocatedError] = InvalidValueError
) -> int:
    """Return a whole number, at least ``least``. Raises ``error``."""
    is_whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    require(where, is_whole, "a whole number", repr(value), error)
    require(where, least is None or value >= least, f"at least {least}", value, error)
    return int(value)


def checked_finite(where: str, value: Any, expected: str = "a number") -> float:
    """Return a finite number. Raises InvalidValueError with ``expected`` in the message."""
    is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    require(where, is_number and math.isfinite(value), expected, value if is_number else repr(value))
    return float(value)


def checked_positive(where: str, value: Any, expected: str = "a number above 0", *, most: float = math.inf) -> float:
    """Return a number above 0 and at most ``most``. Raises InvalidValueError with ``expected`` in the message."""
    number = checked_finite(where, value, expected)
    require(where, 0 < number <= most, expected, value)
    return number


def checked_share(where: str, value: Any) -> float:
    """Return a number from 0 to 1. Raises InvalidValueError."""
    expected = "a number from 0 to 1"
    number = checked_finite(where, value, expected)
    if not 0 <= number <= 1:
        remedy = f"for {number:g} percent give {number / 100:g}" if 1 < number <= 100 else ""
        raise InvalidValueError.at(where, expected, value, remedy)
    return number
