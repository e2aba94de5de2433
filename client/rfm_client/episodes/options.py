# SPDX-License-Identifier: MIT
"""Options for an episode, and the scores at each step. N episodes, H x W pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias, TypedDict, get_args

from rfm_client.contract.checks import checked_count, checked_share, require
from rfm_client.contract.description import ModelInfo
from rfm_client.contract.results import SUCCESS_THRESHOLD
from rfm_client.frames.orientation import FUSES, ChannelOrder, Correction, Fuse, Orientation
from rfm_client.frames.sampling import Rule, Sampling

StepValue: TypeAlias = Literal["progress", "remaining_s"]


@dataclass(frozen=True)
class StepScore:
    """One episode's score at its newest frame.

    progress: share of the task done, 0..1; NaN with ``score="remaining_s"`` if the checkpoint does not predict progress
    success: probability that the task is done; NaN: the checkpoint does not predict success
    succeeded: True if the success rule holds; False where success is NaN
    step: the scored frame's index in the episode, from 0
    ms: milliseconds to the answer
    more_scores: other scores for the frame, by name in ``FRAME_SCORES``: marks as bool, numbers as float. With several
        cameras, numbers are fused, and a mark is True if any camera has it
    """

    progress: float
    success: float
    succeeded: bool
    step: int
    ms: float
    more_scores: Mapping[str, float] = field(default_factory=dict, hash=False)

    @property
    def unclear(self) -> bool:
        """True if a written answer states no single whole score (RoboReward only)."""
        return bool(self.more_scores.get("unclear"))

    def value(self, score: StepValue) -> float:
        """Return the number that grows towards task completion: progress, or minus the remaining seconds."""
        return self.progress if score == "progress" else -self.more_scores[score]


@dataclass(frozen=True)
class SuccessRule:
    """A step succeeds if most of the last distinct frames in the sample reach ``threshold``.

    threshold: lowest success that such a frame needs, 0..1
    last: how many frames vote; each distinct frame votes once, even if it is repeated or padded

    Raises ValueError.
    """

    threshold: float = SUCCESS_THRESHOLD
    last: int = 1

    def __post_init__(self) -> None:
        checked_share("threshold", self.threshold)
        checked_count("last", self.last)


class StepKeywords(TypedDict, total=False):
    """EpisodeOptions fields as keyword arguments."""

    sampling: Rule | None
    frames: int | None
    cameras: Sequence[str]
    fuse: Fuse
    orient: Orientation | Mapping[str, Orientation]
    channels: ChannelOrder | Mapping[str, ChannelOrder]
    resize: bool
    weights_digest: str | None
    success: SuccessRule
    timeout_s: float | None
    score: StepValue


@dataclass(frozen=True, kw_only=True)
class FrameOptions:
    """How to read an episode's frames. Raises ValueError for contradictory options.

    sampling: a rule in ``rfm_client.frames.sampling``; None: as in training
    cameras: camera names, one frame each per step; empty: a single camera without a name
    fuse: how to combine scores from several cameras
    orient: rotation or flip to make frames upright, applied first: an Orientation, or a dict by camera; omitted cameras
        are not turned
    channels: colour order in the given frames, ``rgb`` or ``bgr``: one for all cameras, or a dict by camera
    resize: True: shrink frames to the checkpoint's size before they are kept and sent (needs Pillow); ReWiND's scores
        then differ slightly
    weights_digest: score only with the checkpoint whose ``client.model_info(frames=True).weights_digest`` this is, else
        a step raises InferenceFailedError; None: with any
    score: the score that rewards are made from, ``progress`` or ``remaining_s``; a step raises ValueError if the
        checkpoint does not predict it
    """

    sampling: Rule | None = None
    cameras: Sequence[str] = ()
    fuse: Fuse = "mean"
    orient: Orientation | Mapping[str, Orientation] = "none"
    channels: ChannelOrder | Mapping[str, ChannelOrder] = "rgb"
    resize: bool = False
    weights_digest: str | None = None
    score: StepValue = "progress"

    def __post_init__(self) -> None:
        require(
            "score", self.score in get_args(StepValue), f"one of {', '.join(get_args(StepValue))}", repr(self.score)
        )
        require("cameras", not isinstance(self.cameras, str), "a sequence of names", repr(self.cameras))
        object.__setattr__(self, "cameras", tuple(self.cameras))
        is_each_once = len(set(self.cameras)) == len(self.cameras)
        require("cameras", is_each_once, "names that differ", list(self.cameras))
        require("fuse", self.fuse in FUSES, f"one of {', '.join(FUSES)}", repr(self.fuse))
        cameras = list(self.cameras)
        expected = f"some of the cameras {cameras}" if cameras else "one for all frames, as cameras names none"
        by_camera = {name: getattr(self, name) for name in ("orient", "channels")}
        for name, given in by_camera.items():
            unknown = [] if isinstance(given, str) else [repr(each) for each in given if each not in cameras]
            require(name, not unknown, expected, ", ".join(unknown))
        self.corrections  # noqa: B018  raises ValueError for an unknown value

    @property
    def corrections(self) -> list[Correction]:
        """One correction per camera, in camera order."""
        return [Correction.of(camera, self.orient, self.channels) for camera in self.cameras or ("",)]


@dataclass(frozen=True, kw_only=True)
class EpisodeOptions(FrameOptions):
    """How to score each step in an episode. Raises ValueError for contradictory options.

    frames: frame count for the rule; None: fixed by the rule, else ``ModelInfo.max_frames``. If neither gives a
        count, the first step raises ValueError
    success: decides whether a step succeeds
    timeout_s: time limit for a step with all retries; None: the client's
    """

    frames: int | None = None
    success: SuccessRule = SuccessRule()
    timeout_s: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        Sampling.of(self.sampling, self.frames, trained_frames=1)  # raises ValueError; 1 stands in for the checkpoint's

    def sampling_for(self, info: ModelInfo) -> Sampling:
        """Return the rule and frame count for a checkpoint.

        Raises ValueError without a needed count, InvalidSampleError if the checkpoint needs the whole episode.
        """
        info.check_scores_prefixes()
        return Sampling.of(self.sampling, self.frames, info.max_frames, trained_padding=info.trained_padding)
