# SPDX-License-Identifier: MIT
"""Checks of numbers from callers: Python's or numpy's, but no bool, text or NaN."""

from __future__ import annotations

import math
import numbers
from typing import Any

from rfm_client.contract.checks import require
from rfm_client.contract.errors import InvalidValueError, LocatedError


def checked_count(
    where: str, value: Any, *, least: int | None = 1, error: type[LocatedError] = InvalidValueError
) -> int:
    """Return a whole number of at least ``least``. Raises ``error``."""
    is_whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    require(where, is_whole, "a whole number", repr(value), error)
    require(where, least is None or value >= least, f"at least {least}", value, error)
    return int(value)


def checked_finite(where: str, value: Any, expected: str = "a number") -> float:
    """Return a finite number. Raises InvalidValueError, whose message says ``expected``."""
    is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    require(where, is_number and math.isfinite(value), expected, value if is_number else repr(value))
    return float(value)


def checked_positive(where: str, value: Any, expected: str = "a number above 0", *, most: float = math.inf) -> float:
    """Return a number above 0 and at most ``most``. Raises InvalidValueError, whose message says ``expected``."""
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
