# SPDX-License-Identifier: MIT
"""Sampling rules: which frames the model sees when frame t is the newest.

``docs/guides/choose_frames.md`` lists the rules and who uses them. No rule shows a frame after t.

Shapes: K frames in the rule, S slots in the sample, T frames in the episode.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from rfm_client.contract.checks import checked_count, require
from rfm_client.contract.results import ProgressResult
from rfm_client.contract.samples import ProgressSample, Trajectory

Rule: TypeAlias = Literal[
    "linspace_trunc", "linspace_round", "rint", "rint_pad", "rewind_pad16_online", "rewind_pad16_offline", "all"
]
FrameIndices: TypeAlias = npt.NDArray[np.int64]

RULES: tuple[Rule, ...] = get_args(Rule)
REWIND_FRAMES = 16  # fixed in the first ReWiND code, for every checkpoint

MAX_BYTES = 32 * 2**20  # of samples in memory: their frames are copies

_REWIND: tuple[Rule, ...] = ("rewind_pad16_online", "rewind_pad16_offline")
_PADDED: tuple[Rule, ...] = ("rint_pad", *_REWIND)  # filled up to K slots with the newest frame


@dataclass(frozen=True, eq=False)
class Prefix:
    """Which frames from 0 to t a rule shows, and which slot's score counts for frame t.

    indices: int64 [S], the frame in each slot, padding included
    read: the slot whose score counts for frame t
    """

    indices: FrameIndices
    read: int

    @property
    def frame_slots(self) -> FrameIndices:
        """int64 [N], one slot for each of the N distinct frames, in order.

        A repeated frame takes its last slot; frame t takes the slot ``read``.
        """
        slots = np.flatnonzero(np.diff(self.indices, append=self.indices[-1] + 1))
        slots[-1] = self.read
        return slots


@dataclass(frozen=True)
class Sampling:
    """A sampling rule and its frame count. Raises ValueError if the rule does not accept the count.

    frames: K; None for the rule ``all``. For ``rewind_pad16_*``, None becomes 16
    """

    rule: Rule
    frames: int | None = None

    def __post_init__(self) -> None:
        require("sampling", self.rule in RULES, f"one of {', '.join(RULES)}", repr(self.rule))
        with_rule = f"with the rule {self.rule}"
        if self.rule == "all":
            require("frames", self.frames is None, f"none {with_rule}", self.frames)
        elif self.rule in _REWIND:
            require("frames", self.frames in (None, REWIND_FRAMES), f"{REWIND_FRAMES} {with_rule}", self.frames)
            object.__setattr__(self, "frames", REWIND_FRAMES)
        else:
            require("frames", self.frames is not None, f"at least 1 {with_rule}", self.frames)
            object.__setattr__(self, "frames", checked_count("frames", self.frames))

    @classmethod
    def of(
        cls, rule: Rule | None, frames: int | None, trained_frames: int | None, *, trained_padding: bool = True
    ) -> Sampling:
        """Return the caller's rule and frame count.

        None: as in training, but ``rewind_pad16_*`` takes 16 and ``all`` no count

        trained_frames, trained_padding: ``max_frames`` and ``trained_padding`` in the checkpoint's ``ModelInfo``

        Raises ValueError if neither caller nor checkpoint gives a required count.
        """
        rule = rule or ("rint_pad" if trained_padding else "rint")
        if frames is None and rule not in (*_REWIND, "all"):
            frames = trained_frames
            got = "none, and the checkpoint does not say how many it was trained on"
            require("frames", frames is not None, f"how many frames the rule {rule} shows the model", got)
        return cls(rule, frames)

    def __str__(self) -> str:
        return self.rule if self.frames is None else f"{self.rule}, {self.frames} frames"

    def prefix(self, t: int) -> Prefix:
        """Return the frames to show when frame ``t``, counted from 0, is the newest."""
        if self.frames is None:
            shown = np.arange(t + 1)
        elif self.rule in ("rint", "rint_pad"):
            shown = _rint(t, self.frames)
        elif self.rule in _REWIND and t < self.frames:
            shown = np.arange(t + 1)
        else:
            even = np.linspace(0, t, self.frames)
            shown = (even.round() if self.rule == "linspace_round" else even).astype(np.int64)
        own_slot = len(shown) - 1
        if self.frames is not None and self.rule in _PADDED:
            shown = np.append(shown, np.repeat(t, self.frames - len(shown)))
        return Prefix(shown, own_slot if self.rule == "rewind_pad16_offline" else len(shown) - 1)

    def samples(self, trajectory: Trajectory) -> Iterator[ProgressSample]:
        """Yield a sample for every prefix, for t from 0 to T - 1. Raises InvalidSampleError."""
        for t in range(trajectory.num_frames):
            yield ProgressSample(taken(trajectory, self.prefix(t).indices))

    def parts(self, trajectory: Trajectory) -> Iterator[list[ProgressSample]]:
        """Yield the ``samples`` in lists that hold at most MAX_BYTES, or one sample. Raises InvalidSampleError."""
        part: list[ProgressSample] = []
        num_bytes = 0
        for sample in self.samples(trajectory):
            own = sum(array.nbytes for array in (sample.trajectory.positions, *sample.trajectory.views))
            if part and num_bytes + own > MAX_BYTES:
                yield part
                part, num_bytes = [], 0
            part.append(sample)
            num_bytes += own
        if part:
            yield part

    def joined(self, results: Sequence[ProgressResult]) -> ProgressResult:
        """Return the episode's result: frame t takes its scores from prefix 0..t at the slot ``Prefix.read``.

        results: [T], for the samples from ``samples``

        Raises InferenceFailedError for results from several checkpoint versions.
        """
        reads = (self.prefix(t).read for t in range(len(results)))
        return ProgressResult.of_parts(
            [result.at(slice(read, read + 1)) for result, read in zip(results, reads, strict=True)]
        )


def thinned(num_frames: int, limit: int | None) -> FrameIndices | None:
    """Return which frames, int64 [limit], training would keep from a longer clip; None: all are kept.

    Uses the rule ``rint``, by which upstream cuts training clips.
    """
    return None if limit is None or num_frames <= limit else _rint(num_frames - 1, limit)


def taken(trajectory: Trajectory, indices: FrameIndices) -> Trajectory:
    """Return the trajectory with the frames or embeddings at ``indices``, int64 [N], and its task."""
    if trajectory.frames is not None:
        views = tuple(view[indices] for view in trajectory.views)
        return replace(trajectory, frames=trajectory.frames[indices], views=views)
    assert trajectory.video_embeddings is not None  # a Trajectory has frames or embeddings
    return replace(trajectory, video_embeddings=trajectory.video_embeddings[indices])


def _rint(t: int, frames: int) -> FrameIndices:
    if t < frames:
        return np.arange(t + 1)
    if frames == 1:
        return np.array([t], np.int64)
    return np.linspace(0, t, frames).round().astype(np.int64)  # keeps the ends 0 and t, and the order
