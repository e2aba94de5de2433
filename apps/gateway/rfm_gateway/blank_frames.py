# SPDX-License-Identifier: MIT
"""Tell callers of frames that show nothing: floats in 0..1 that became uint8, or zeros that pad a clip."""

from __future__ import annotations

from collections.abc import Sequence

from rfm_client import InvalidSampleError, Sample, Trajectory, UInt8Array
from rfm_client.frames import BlankFrames
from rfm_client.options import first_names

WARNING_HEADER = "X-RFM-Warning"  # of answers whose scores mean nothing
PADDING = "frames of zeros at the end (send the real frames alone, without padding)"
MOST_NAMES = 12  # samples that a warning names


def warning_of(samples: Sequence[Sample]) -> str:
    """Return a warning that names the samples with blank frames, or with zeros at the end; empty if there are none."""
    shown = [(index, t.frames) for index, sample in enumerate(samples) for t in sample.trajectories if t is not None]
    clips = [(index, frames, BlankFrames(frames)) for index, frames in shown if frames is not None]
    blank = {index: found for index, _, found in clips if found.told}
    padded = dict.fromkeys(index for index, frames, found in clips if not found.told and _is_padded(frames))
    warnings = []
    if blank:
        told = max(blank.values(), key=lambda found: found.highest or 0).told
        warnings.append(f"samples {first_names(blank, MOST_NAMES)}: {told}: their scores mean nothing")
    if padded:
        warnings.append(f"samples {first_names(padded, MOST_NAMES)}: {PADDING}: they are scored as pictures")
    return "; ".join(warnings)


def refuse_blank_frames(trajectory: Trajectory) -> None:
    """Raise InvalidSampleError for blank frames, and for frames of zeros at the end."""
    if trajectory.frames is None:
        return
    told = BlankFrames(trajectory.frames).told or PADDING * _is_padded(trajectory.frames)
    if told:
        raise InvalidSampleError.at("frames", "pictures that show something", told)


def _is_padded(frames: UInt8Array) -> bool:
    """True if zeros follow a picture, up to the last frame."""
    return not frames[-1].any() and bool(frames.any())
