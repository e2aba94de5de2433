# SPDX-License-Identifier: MIT
"""A clock of a test's own."""

from __future__ import annotations


class Clock:
    """A ``time`` module whose time passes when the test says so."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        self.now_s += duration_s
