# SPDX-License-Identifier: MIT
"""Recognise texts that are no task sentences: blanks, placeholders, identifiers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rfm_client.options import first_names


def is_identifier(task: str) -> bool:
    """True if a task is a single word of ASCII, such as ``PnPCupToDrawerClose`` or ``pick_place_cup``."""
    return task.isascii() and len(task.split()) == 1


def identifiers_told(tasks: Iterable[str]) -> list[str]:
    """Return a line that lists single-word tasks; empty if all tasks are sentences."""
    known = dict.fromkeys(tasks)
    found = [task for task in known if is_identifier(task)]
    if not found:
        return []
    remedy = "--task with --override-task gives all episodes a sentence, --task-column reads another column (LeRobot)"
    return [
        f"tasks: {len(found)} of {len(known)} are a single word, not a sentence ({first_names(found, 3)}); {remedy}"
    ]


def one_line(task: Any) -> Any:
    """Return a task with each run of spaces and line breaks as one space, and none at the ends."""
    return " ".join(task.split()) if isinstance(task, str) else task
