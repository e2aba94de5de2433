# SPDX-License-Identifier: MIT
"""For how long requests may have waited in Triton unseen: it tells a model of none before it hands them over."""

from __future__ import annotations

import math
import time

CALL_S = 1e-3  # within it Triton calls again if something waits, or sends one response; twice so long for two
REQUEST_S = 0.25e-3  # more for each request that it hands over
COPY_S_PER_BYTE = 2e-9  # and for its inputs, which Triton copies
LATE_CALLS = 2  # one may be late because the machine is busy
SURELY = 10  # but not by so many times


class TritonQueue:
    """Triton's queue of requests for a model, as the times of the calls of ``execute`` show it.

    When ``execute`` has returned, Triton sends the responses that it gave back, and hands over what waits. If it takes
    longer than that to call again, nothing waited. The queue counts as empty after LATE_CALLS such calls in a row, or
    one that comes SURELY times as late.
    """

    def __init__(self) -> None:
        self._returned_s = self._empty_s = -math.inf  # before the first call nothing has waited
        self._num_responses = self._num_late = 0

    @property
    def unseen_s(self) -> float:
        """Seconds since the queue last counted as empty: as far as that tells, none has waited in it for longer."""
        return time.monotonic() - self._empty_s

    def called(self, called_s: float, num_requests: int, num_bytes: int) -> None:
        """Notes that Triton has called ``execute`` with so many requests, with so many bytes of inputs.

        called_s: when, by time.monotonic
        """
        needed_s = CALL_S * max(self._num_responses, 1) + REQUEST_S * num_requests + COPY_S_PER_BYTE * num_bytes
        took_s = called_s - self._returned_s
        self._num_late = self._num_late + 1 if took_s >= needed_s else 0
        if self._num_late >= LATE_CALLS or took_s >= SURELY * needed_s:
            self._empty_s = called_s

    def returned(self, num_responses: int) -> None:
        """Notes that ``execute`` returns, with so many responses for Triton to send."""
        self._returned_s, self._num_responses = time.monotonic(), num_responses
