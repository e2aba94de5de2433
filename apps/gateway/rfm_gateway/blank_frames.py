# SPDX-License-Identifier: MIT
"""Tell callers of samples whose frames show nothing, such as floats in 0..1 that became uint8."""

from __future__ import annotations

from collections.abc import Sequence

from rfm_client import InvalidSampleError, Sample, Trajectory
from rfm_client.frames import BlankFrames
from rfm_client.options import first_names

WARNING_HEADER = "X-RFM-Warning"  # of answers whose scores mean nothing
MOST_NAMES = 12  # samples that a warning names


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
