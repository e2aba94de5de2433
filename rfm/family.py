# SPDX-License-Identifier: MIT
"""The seam of a family of checkpoints: what the engine and the export need of it.

A package that holds a ``FAMILY`` is one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from rfm.checkpoint.provenance import Decision
from rfm_client.contract import FrameSize, RewardError
from rfm_client.contract.frame_refs import EncoderSampleRefs
from rfm_client.contract.samples import EncoderSample, Float32Array

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from rfm.engine.execution import Execution
    from rfm.engine.feature_cache import FeatureCache
    from rfm.engine.predictor import Predictor

NETWORK = "network"  # in Checkpoint.parts: the weights of the network that scores
_USUAL_HEADS = ("has_preference", "has_success")  # fields of configurations


@dataclass(frozen=True)
class Options:
    """What a user may say of a checkpoint that its files do not hold. Each family reads its own fields.

    base_model: folder or id of a vision-language checkpoint's backbone; None: the one that the checkpoint names
    image_encoder, text_encoder: folders or ids of a ReWiND checkpoint's encoders; None: the usual ones, if the
        checkpoint has weights of encoders
    """

    base_model: str | None = None
    image_encoder: str | None = None
    text_encoder: str | None = None


@dataclass(frozen=True)
class Description:
    """What a checkpoint takes, and what it answers.

    widths: Dv and Dt of the embeddings that it scores; None: it scores raw frames
    progress_bins: K; 1: continuous progress
    max_frames: the longest trajectory that its network can take; None: any length
    trained_frames, trained_padding: the most frames of a trajectory in training, and whether shorter ones were padded;
        None: the checkpoint does not say
    frame_size: to what it brings each raw frame; None: that depends on the frame
    frames_per_value: frames that share their scores
    keeps_features: it can keep what it makes of frames, and takes samples with named frames then
    is_large: its exports are verified in the type that serves it, and on a GPU with room for it, since float32 on the
        CPU takes long
    """

    network_class: str
    widths: tuple[int, int] | None
    progress_bins: int
    has_similarity: bool
    max_frames: int | None = None
    trained_frames: int | None = None
    trained_padding: bool | None = None
    frame_size: FrameSize | None = None
    frames_per_value: int = 1
    keeps_features: bool = False
    is_large: bool = False
    has_preference: bool = True
    has_success: bool = True

    @property
    def lacks(self) -> frozenset[str]:
        """Names of the heads that the network has not."""
        heads = {"preference": self.has_preference, "success": self.has_success, "similarity": self.has_similarity}
        return frozenset(name for name, is_there in heads.items() if not is_there)


def config_fields(config: Any) -> dict[str, Any]:
    """The fields of a network's configuration, as files and digests have them.

    The heads of preference and of success are named only where they are missing, as before networks could lack them.
    """
    fields = asdict(config)
    return {name: value for name, value in fields.items() if name not in _USUAL_HEADS or not value}


@dataclass(frozen=True)
class EncodersDescription:
    """What the export records of encoders; ``frame_size``: to what they bring each raw frame; None: it depends."""

    network_class: str
    frame_size: FrameSize | None = None


class FrameEncoders(Protocol):
    """Networks that make the embeddings that a checkpoint scores of raw frames and their task."""

    @classmethod
    def load(cls, folder: Path) -> FrameEncoders:
        """The encoders that ``save`` wrote into ``folder``."""

    @classmethod
    def describe(cls, folder: Path) -> EncodersDescription:
        """The description of the encoders that ``save`` wrote into ``folder``, without loading them."""

    @property
    def description(self) -> EncodersDescription:
        """What the export records of these encoders."""

    def save(self, folder: Path) -> None:
        """Writes them into a folder that may be there, so that ``load`` needs no network."""

    def to(self, device: torch.device) -> FrameEncoders:
        """Moves the encoders to ``device``, and returns them."""

    def encode(
        self,
        samples: Sequence[EncoderSample | EncoderSampleRefs],
        execution: Execution,
        cache: FeatureCache[Float32Array] | None,
    ) -> list[EncoderSample | RewardError]:
        """Each sample with embeddings of its trajectories' frames and of its task, or why it has none.

        execution: what it took is added to it
        cache: where it keeps embeddings, and finds those that it has kept; None: nowhere, and no frames are named
        """


class Checkpoint(Protocol):
    """A checkpoint in memory, with its weights."""

    @property
    def config(self) -> Any:
        """What its network looks like: a dataclass."""

    @property
    def description(self) -> Description:
        """What the checkpoint takes, and what it answers."""

    @property
    def parts(self) -> Mapping[str, Mapping[str, Tensor]]:
        """All weights by part and name. The part NETWORK is always there."""

    @property
    def notes(self) -> Sequence[str]:
        """A line for the user on each thing that contradicts what is known of the training run."""

    def decisions(self) -> Sequence[Decision]:
        """What decided each thing that scores depend on. Raises CheckpointError for files that cannot be had."""

    def encoders(self) -> FrameEncoders | None:
        """The checkpoint's encoders; None: it has none. Raises CheckpointError if they cannot be had or do not fit."""

    def predictor(
        self, device: torch.device, dtype: torch.dtype | None = None, cache: FeatureCache[Any] | None = None
    ) -> Predictor[Any, Any]:
        """The checkpoint's network on ``device``, as a predictor. Raises CheckpointError.

        dtype: of the network; None: as checkpoint and device decide
        cache: where it keeps what it makes of frames, if the description says that it does; None: nowhere
        """

    def save(self, folder: Path) -> None:
        """Writes all but its encoders into a new folder that its family loads without options and without network."""


@dataclass(frozen=True)
class Family:
    """How checkpoints of one kind are recognised and loaded.

    name: the package that has this as its ``FAMILY``
    reads: whether a folder may hold a checkpoint of this kind; used where nobody names the family
    load: the checkpoint in a local folder; raises CheckpointError
    encoders: the class of its checkpoints' encoders; None: they score raw frames
    """

    name: str
    reads: Callable[[Path], bool]
    load: Callable[[Path, Options], Checkpoint]
    encoders: type[FrameEncoders] | None = None
