# SPDX-License-Identifier: MIT
"""A bound on the frames that the workers of one process hold at a time."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from traceback import clear_frames

MAX_FRAME_BYTES = 2 * 2**30


class FrameMemory:
    """Bytes of frames that all workers together may hold; more only where one film alone has more."""

    def __init__(self, max_bytes: int = MAX_FRAME_BYTES) -> None:
        self._max_bytes = max_bytes
        self._held_bytes = 0
        self._changed = threading.Condition()

    @contextmanager
    def holding(self, num_bytes: int) -> Iterator[None]:
        """Holds so many bytes, after a wait until they fit. A worker that holds some must not ask for more."""
        with self._changed:
            self._changed.wait_for(lambda: not self._held_bytes or self._held_bytes + num_bytes <= self._max_bytes)
            self._held_bytes += num_bytes
        try:
            yield
        except Exception as error:
            clear_frames(error.__traceback__)  # or the error would hold them for as long as it is there itself
            raise
        finally:
            with self._changed:
                self._held_bytes -= num_bytes
                self._changed.notify_all()
