# SPDX-License-Identifier: MIT
"""Tell callers and the log of samples whose frames show nothing, such as floats in 0..1 that became uint8."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence

from rfm_client import InvalidSampleError, Sample, Trajectory
from rfm_client.frames import BlankFrames
from rfm_client.options import first_names

WARNING_HEADER = "X-RFM-Warning"  # of answers whose scores mean nothing
LINE_EVERY_S = 10.0  # a caller that sends floats as uint8 does so with every request
MOST_NAMES = 12  # samples that a warning names

logger = logging.getLogger("rfm_gateway")


def warning_of(samples: Sequence[Sample]) -> str:
    """Return a warning that names the samples with blank frames; empty: no sample has them."""
    shown = [(index, t.frames) for index, sample in enumerate(samples) for t in sample.trajectories]
    blank = [(index, found) for index, t in shown if t is not None and (found := BlankFrames(t)).told]
    if not blank:
        return ""
    names = first_names(dict.fromkeys(index for index, _ in blank), MOST_NAMES)
    told = max((found for _, found in blank), key=lambda found: found.highest or 0).told
    return f"samples {names}: {told}: their scores mean nothing"


def refuse_blank_frames(trajectory: Trajectory) -> None:
    """Raise InvalidSampleError for blank frames."""
    told = "" if trajectory.frames is None else BlankFrames(trajectory.frames).told
    if told:
        raise InvalidSampleError.at("frames", "pictures that show something", told)


class WarningLog:
    """Logs one warning in LINE_EVERY_S, and how many requests had one in between. clock_s: returns the time"""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._due_s = float("-inf")
        self._num_left_out = 0

    def write(self, warning: str) -> None:
        """Log a warning, or count it."""
        now_s = self._clock_s()
        if now_s < self._due_s:
            self._num_left_out += 1
            return
        left_out = f"; {self._num_left_out} requests before had such samples, too" if self._num_left_out else ""
        logger.warning("%s%s", warning, left_out)
        self._due_s, self._num_left_out = now_s + LINE_EVERY_S, 0
