# SPDX-License-Identifier: MIT
"""Which frames of an episode a model is shown when the newest is frame t: the rules in use, by name.

    rule                  shows of the frames 0..t                             padding              read at
    linspace_trunc        linspace(0, t, K), cut to whole numbers              none                 last slot
    linspace_round        linspace(0, t, K), rounded half to even              none                 last slot
    rint                  all while t + 1 <= K, then linspace(0, t, K)         none                 last slot
                          rounded half to even
    rint_pad              the same                                             the last frame, to   last slot
                                                                               K slots
    rewind_pad16_online   all while t + 1 <= 16, then linspace(0, t, 16) cut   the last frame, to   last slot
                                                                               16 slots
    rewind_pad16_offline  the same                                             the same             slot min(t, 15)
    all                   all                                                  none                 last slot

``linspace_trunc`` is what the evaluation server's frame steps do (``frame_steps`` on the wire), ``linspace_round``
LeRobot's Robometer labels, ``rint_pad`` the RL loop and relabelling of ``robometer``, ``rint`` the same for a
checkpoint whose training did not pad; the two readings of ``rewind_pad16`` are those of the first ReWiND code, online
and for offline labels. The first two repeat frames while t + 1 < K, and with K = 1 they show frame 0; ``rint`` and
``rint_pad`` then show frame t. No rule shows a frame after t.

Shapes: K frames that the rule shows, S slots of the sample that is sent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from rfm_client.contract.numbers import checked_count

Rule: TypeAlias = Literal[
    "linspace_trunc", "linspace_round", "rint", "rint_pad", "rewind_pad16_online", "rewind_pad16_offline", "all"
]
FrameIndices: TypeAlias = npt.NDArray[np.int64]

RULES: tuple[Rule, ...] = get_args(Rule)
REWIND_FRAMES = 16  # of the first ReWiND code, whatever its checkpoint

_REWIND: tuple[Rule, ...] = ("rewind_pad16_online", "rewind_pad16_offline")


def trained_rule(trained_padding: bool) -> Rule:
    """The rule by which a checkpoint's training cut its clips, and padded shorter ones or did not."""
    return "rint_pad" if trained_padding else "rint"


@dataclass(frozen=True, eq=False)
class Prefix:
    """What a model is shown of the frames 0..t, and where its answer about frame t is.

    indices: int64 [S], the frame in each slot, padding included
    num_padding: how many of the last slots are padding
    read: the slot whose score is that of frame t
    """

    indices: FrameIndices
    num_padding: int
    read: int

    @property
    def frame_slots(self) -> FrameIndices:
        """int64 [N], a slot of each frame that is shown, in order.

        Of a frame that repeats the last one, of frame t the one that is read.
        """
        slots = np.flatnonzero(np.diff(self.indices, append=self.indices[-1] + 1))
        slots[-1] = self.read
        return slots


@dataclass(frozen=True)
class Sampling:
    """A rule, and how many frames it shows. Raises ValueError for a number that the rule does not take.

    frames: K; None where the rule needs none (``all``) or has its own (``rewind_pad16_*``: 16)
    """

    rule: Rule
    frames: int | None = None

    def __post_init__(self) -> None:
        if self.rule not in RULES:
            raise ValueError(f"sampling: expected one of {', '.join(RULES)}, got {self.rule!r}")
        if self.rule == "all" and self.frames is not None:
            raise ValueError(f"frames: expected none with the rule all, got {self.frames}")
        if self.rule in _REWIND:
            if self.frames not in (None, REWIND_FRAMES):
                raise ValueError(f"frames: expected {REWIND_FRAMES} with the rule {self.rule}, got {self.frames}")
            object.__setattr__(self, "frames", REWIND_FRAMES)
        elif self.rule != "all":
            if self.frames is None:
                raise ValueError(f"frames: expected at least 1 with the rule {self.rule}, got None")
            object.__setattr__(self, "frames", checked_count("frames", self.frames))

    @classmethod
    def of(
        cls, rule: Rule | None, frames: int | None, trained_frames: int | None, *, trained_padding: bool = True
    ) -> Sampling:
        """The rule and its number of frames: where the caller says neither (None), those of the checkpoint's training.

        trained_frames, trained_padding: ``max_frames`` and ``trained_padding`` of the checkpoint's ``ModelInfo``

        Raises ValueError if neither says how many frames a rule shows that needs a number.
        """
        rule = rule or trained_rule(trained_padding)
        if frames is None and rule not in (*_REWIND, "all"):
            frames = trained_frames
            if frames is None:
                got = "none, and the checkpoint does not say how many it was trained on"
                raise ValueError(f"frames: expected how many frames the rule {rule} shows the model, got {got}")
        return cls(rule, frames)

    def __str__(self) -> str:
        return self.rule if self.frames is None else f"{self.rule}, {self.frames} frames"

    def prefix(self, t: int) -> Prefix:
        """What the model is shown when frame ``t``, counted from 0, is the newest."""
        if self.frames is None:
            return _unpadded(np.arange(t + 1))
        if self.rule == "linspace_trunc":
            return _unpadded(np.linspace(0, t, self.frames).astype(np.int64))
        if self.rule == "linspace_round":
            return _unpadded(np.linspace(0, t, self.frames).round().astype(np.int64))
        if self.rule == "rint":
            return _unpadded(_rint(t, self.frames))
        if self.rule == "rint_pad":
            return _padded(_rint(t, self.frames), self.frames)
        shown = np.arange(t + 1) if t < self.frames else np.linspace(0, t, self.frames).astype(np.int64)
        read = self.frames - 1 if self.rule == "rewind_pad16_online" else len(shown) - 1
        return _padded(shown, self.frames, read)


def thinned(num_frames: int, limit: int | None) -> FrameIndices | None:
    """int64 [limit], the frames of a longer clip that training would have kept; None: all may stay.

    As ``robometer`` cuts its training clips: the rule ``rint``.
    """
    return None if limit is None or num_frames <= limit else _rint(num_frames - 1, limit)


def _rint(t: int, frames: int) -> FrameIndices:
    if t < frames:
        return np.arange(t + 1)
    if frames == 1:
        return np.array([t], np.int64)
    return np.linspace(0, t, frames).round().astype(np.int64)  # 0 and t are whole, and rounding keeps the order


def _unpadded(indices: FrameIndices) -> Prefix:
    return Prefix(indices, 0, len(indices) - 1)


def _padded(shown: FrameIndices, slots: int, read: int | None = None) -> Prefix:
    num_padding = max(slots - len(shown), 0)
    indices = np.append(shown, np.repeat(shown[-1:], num_padding))
    return Prefix(indices, num_padding, slots - 1 if read is None else read)
