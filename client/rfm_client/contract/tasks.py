# SPDX-License-Identifier: MIT
"""Recognise texts that are no task sentences."""

from __future__ import annotations

from typing import Any

_PLACEHOLDERS = {"none", "null", "nan", "n/a", "n.a.", "na", "todo", "tbd", "unknown"}


def is_blank(task: Any) -> bool:
    """True for a task without a value, letter or digit, and for a placeholder such as ``N/A``."""
    if isinstance(task, str):
        text = task.strip().casefold()
        return text in _PLACEHOLDERS or not any(map(str.isalnum, text))
    return not task or task != task  # NaN differs from itself
