# SPDX-License-Identifier: MIT
"""One form for what is wrong with a value: ``where: expected X, got Y``."""

from __future__ import annotations


def require(where: object, condition: bool, expected: str, got: object, error: type[Exception] = ValueError) -> None:
    """Raises the error, ``where: expected X, got Y``, unless the condition holds."""
    if not condition:
        raise error(f"{where}: expected {expected}, got {got}")
