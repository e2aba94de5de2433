# SPDX-License-Identifier: MIT
"""The form of messages about invalid values: ``where: expected X, got Y``."""

from __future__ import annotations

from collections.abc import Collection


def require(where: object, condition: bool, expected: str, got: object, error: type[Exception] = ValueError) -> None:
    """Raise ``error`` with the message ``where: expected X, got Y`` unless the condition holds."""
    if not condition:
        raise error(f"{where}: expected {expected}, got {got}")


def first_names(names: Collection[object], most: int = 5) -> str:
    """Return the first names, and the number of the others."""
    more = len(names) - most
    return ", ".join(map(str, list(names)[:most])) + (f" and {more} more" if more > 0 else "")
