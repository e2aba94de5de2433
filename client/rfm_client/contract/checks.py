# SPDX-License-Identifier: MIT
"""The form of messages about invalid values: ``where: expected X, got Y``."""

from __future__ import annotations


def require(where: object, condition: bool, expected: str, got: object, error: type[Exception] = ValueError) -> None:
    """Raise ``error`` with the message ``where: expected X, got Y`` unless the condition holds."""
    if not condition:
        raise error(f"{where}: expected {expected}, got {got}")
