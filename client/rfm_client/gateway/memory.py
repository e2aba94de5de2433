# SPDX-License-Identifier: MIT
"""What the requests under way may hold in memory, all together."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from fastapi import HTTPException

RETRY_AFTER = {"Retry-After": "1"}


class Memory:
    """``most_bytes`` for all requests, counted before they are taken."""

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._held_bytes = 0
        self._counting = threading.Lock()  # large arrays are made in threads

    @contextmanager
    def share(self) -> Iterator[Share]:
        """One request's, which is free again when the context ends."""
        share = Share(self)
        try:
            yield share
        finally:
            with self._counting:
                self._held_bytes -= share.held_bytes
                share.is_over = True

    def take(self, share: Share, num_bytes: int) -> None:
        """As Share.take."""
        with self._counting:
            if share.held_bytes + num_bytes > self._most_bytes:
                raise HTTPException(
                    413, f"body: expected one that takes at most {self._most_bytes} bytes of memory, got more"
                )
            if share.is_over or self._held_bytes + num_bytes > self._most_bytes:
                raise HTTPException(503, "body: expected room for it, got none: others hold it", RETRY_AFTER)
            share.held_bytes += num_bytes
            self._held_bytes += num_bytes


class Share:
    """What one request holds. is_over: it has ended, though a thread may still work for it"""

    def __init__(self, memory: Memory) -> None:
        self._memory = memory
        self.held_bytes = 0
        self.is_over = False

    def take(self, num_bytes: int) -> None:
        """So many more. Raises HTTPException: 413 if it is too much for one request, 503 if others hold too much."""
        self._memory.take(self, num_bytes)
