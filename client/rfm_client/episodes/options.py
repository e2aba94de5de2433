# SPDX-License-Identifier: MIT
"""How episodes are scored step by step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypedDict

from rfm_client.contract.numbers import checked_count, checked_share
from rfm_client.contract.results import SUCCESS_THRESHOLD
from rfm_client.data.camera_fusion import Fuse, check_fuse, checked_cameras
from rfm_client.data.orientation import Orientation
from rfm_client.data.sampling import Rule, Sampling
from rfm_client.episodes.frames import orientations_of
from rfm_client.episodes.live import LiveView


@dataclass(frozen=True)
class SuccessRule:
    """A scored step succeeds when most of the last frames shown to the model have a success of ``threshold`` or more.
    Raises ValueError.

    threshold: a probability, 0..1
    last: how many frames vote. Padding and repeated frames count once.
    """

    threshold: float = SUCCESS_THRESHOLD
    last: int = 1

    def __post_init__(self) -> None:
        checked_share("threshold", self.threshold)
        checked_count("last", self.last)


class EpisodeSettings(TypedDict, total=False):
    """The fields of EpisodeOptions, as arguments."""

    sampling: Rule | None
    frames: int | None
    cameras: Sequence[str]
    fuse: Fuse
    orient: Orientation | Mapping[str, Orientation]
    resize: bool
    success: SuccessRule
    live: LiveView | None


@dataclass(frozen=True, kw_only=True)
class EpisodeOptions:
    """How each step of an episode is scored. Raises ValueError for contradictory options.

    sampling: which frames of the episode so far a model is shown: a rule of ``rfm_client.data.sampling``; None: that of
        the checkpoint's training
    frames: the rule's number of frames; None: the checkpoint's ``ModelInfo.max_frames``. If it has none, a rule
        that needs a number raises ValueError at the first step
    cameras: names of the cameras whose frames each step brings; none: there is one, without a name
    fuse: how the scores of several cameras become one
    orient: how frames are turned so that they are upright, before all else: an Orientation, or such by camera; a camera
        that is not named: not at all
    resize: frames are made as small as the checkpoint reads them before they are kept and sent (needs Pillow);
        ReWiND's scores differ slightly from those of the frames as they are
    success: when a step counts as a success
    live: where each step is reported to, of several cameras the first one's frame; it delays nothing
    """

    sampling: Rule | None = None
    frames: int | None = None
    cameras: Sequence[str] = ()
    fuse: Fuse = "mean"
    orient: Orientation | Mapping[str, Orientation] = "none"
    resize: bool = False
    success: SuccessRule = SuccessRule()
    live: LiveView | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", checked_cameras(self.cameras))
        check_fuse(self.fuse)
        orientations_of(self.orient, self.cameras)
        Sampling.of(self.sampling, self.frames, trained_frames=1)  # whether rule and number go together
