# SPDX-License-Identifier: MIT
"""Checks of values, and lists of names for messages."""

from __future__ import annotations

from collections.abc import Collection

from rfm_client.contract.errors import InvalidValueError, LocatedError


def require(
    where: object, condition: bool, expected: str, got: object, error: type[LocatedError] = InvalidValueError
) -> None:
    """Raise ``error`` unless the condition holds."""
    if not condition:
        raise error.at(where, expected, got)


def first_names(names: Collection[object], most: int = 5) -> str:
    """Return the first names, and the number of the others."""
    more = len(names) - most
    return ", ".join(map(str, list(names)[:most])) + (f" and {more} more" if more > 0 else "")
