# SPDX-License-Identifier: MIT
"""For how long requests may have waited in Triton unseen: it tells a model of none before it hands them over."""

from __future__ import annotations

import math
import time

HAND_OVER_S = 1e-3  # what waits in Triton comes sooner, if Triton sends one response before; twice so long for two


class TritonQueue:
    """Triton's queue of requests for a model, as the times of the calls of ``execute`` show it.

    When ``execute`` has returned, Triton sends the responses that it gave back, and hands over what waits. If it takes
    longer to call again, nothing waited.
    """

    def __init__(self) -> None:
        self._returned_s = self._empty_s = -math.inf
        self._num_responses = 0

    @property
    def unseen_s(self) -> float:
        """Seconds since the queue was last seen to be empty: no request waits in it for longer."""
        return time.monotonic() - self._empty_s

    def called(self) -> None:
        """Notes that Triton calls ``execute``."""
        called_s = time.monotonic()
        if called_s - self._returned_s >= HAND_OVER_S * max(self._num_responses, 1):
            self._empty_s = called_s

    def returned(self, num_responses: int) -> None:
        """Notes that ``execute`` returns, with so many responses for Triton to send."""
        self._returned_s, self._num_responses = time.monotonic(), num_responses
