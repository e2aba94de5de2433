# SPDX-License-Identifier: MIT
"""Checks of numbers from callers: Python's or numpy's, but no bool, text or NaN."""

from __future__ import annotations

import math
import numbers
from typing import Any


def checked_count(where: str, value: Any, *, least: int = 1) -> int:
    """Return a whole number of at least ``least``. Raises ValueError."""
    if not isinstance(value, numbers.Integral) or isinstance(value, bool):
        raise ValueError(f"{where}: expected a whole number, got {value!r}")
    if value < least:
        raise ValueError(f"{where}: expected at least {least}, got {value}")
    return int(value)


def checked_finite(where: str, value: Any, expected: str = "a number") -> float:
    """Return a finite number. Raises ValueError, whose message says ``expected``."""
    if not isinstance(value, numbers.Real) or isinstance(value, bool) or not math.isfinite(value):
        raise ValueError(f"{where}: expected {expected}, got {_shown(value)}")
    return float(value)


def checked_positive(where: str, value: Any, expected: str = "a number above 0", *, most: float = math.inf) -> float:
    """Return a number above 0 and at most ``most``. Raises ValueError, whose message says ``expected``."""
    if not 0 < checked_finite(where, value, expected) <= most:
        raise ValueError(f"{where}: expected {expected}, got {_shown(value)}")
    return float(value)


def checked_share(where: str, value: Any) -> float:
    """Return a number from 0 to 1. Raises ValueError."""
    expected = "a number from 0 to 1"
    number = checked_finite(where, value, expected)
    if not 0 <= number <= 1:
        hint = f"; for {number:g} percent give {number / 100:g}" if 1 < number <= 100 else ""
        raise ValueError(f"{where}: expected {expected}, got {_shown(value)}{hint}")
    return number


def _shown(value: Any) -> str:
    return f"{value}" if isinstance(value, numbers.Real) else repr(value)
