# SPDX-License-Identifier: MIT
"""The interface between a checkpoint family and the engine and export. A family is a package with a ``FAMILY``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from rfm_client.contract import RewardError, Sample
from rfm_client.contract.description import Description
from rfm_client.contract.samples import EncoderSample, Float32Array

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

    from rfm.engine.execution import Execution
    from rfm.engine.feature_cache import FeatureCache
    from rfm.engine.predictor import Predictor


NETWORK = "network"  # key in Checkpoint.parts: weights for the network that scores
# Network configuration fields that are newer than some exports, with the values that those exports had.
_USUAL = {"has_preference": True, "has_success": True, "video_prompt": "bare", "strict_answers": False, "weights": None}


def config_fields(config: Any) -> dict[str, Any]:
    """Return the fields of a network's configuration, as in files and digests.

    Newer fields are left out if they have the value from older exports, so that older files and digests stay valid.
    """
    return {name: value for name, value in asdict(config).items() if name not in _USUAL or value != _USUAL[name]}


class FrameEncoders(Protocol):
    """Networks that turn raw frames and a task into embeddings for a checkpoint."""

    @classmethod
    def load(cls, folder: Path) -> FrameEncoders:
        """Load the encoders that ``save`` wrote into ``folder``."""

    @classmethod
    def describe(cls, folder: Path) -> Description:
        """Describe the encoders that ``save`` wrote into ``folder``, without loading them."""

    @property
    def description(self) -> Description:
        """The encoders' network and frame size."""

    def save(self, folder: Path) -> None:
        """Write the encoders into a folder, which may exist; ``load`` then needs no internet."""

    def to(self, device: torch.device) -> FrameEncoders:
        """Move the encoders to ``device``, and return them."""

    def encode(
        self,
        samples: Sequence[EncoderSample],
        execution: Execution,
        cache: FeatureCache[Float32Array] | None,
    ) -> list[EncoderSample | RewardError]:
        """Return each sample with embeddings for its frames and task, or its error.

        execution: receives the costs
        cache: embedding cache; None: no cache, and no samples with named frames
        """


class Checkpoint(Protocol):
    """A checkpoint in memory, with its weights."""

    @property
    def config(self) -> Any:
        """The network's configuration, a dataclass."""

    @property
    def description(self) -> Description:
        """The checkpoint's inputs, outputs and limits. The export adds its origin, digests and configuration."""

    @property
    def parts(self) -> Mapping[str, Mapping[str, Tensor]]:
        """All weights by part and name. The part NETWORK always exists."""

    def skeleton(self) -> nn.Module:
        """Return the network without weights, on PyTorch's device ``meta``."""

    def flop(self, sample: Sample) -> float:
        """Return the floating-point operations for scoring a sample: about two per parameter that a token passes.

        Raises CheckpointError, and InvalidSampleError if this checkpoint cannot score the sample.
        """

    def predictor(
        self, device: torch.device, dtype: torch.dtype | None = None, cache: FeatureCache[Any] | None = None
    ) -> Predictor[Any, Any]:
        """Return a predictor with the checkpoint's network on ``device``. Raises CheckpointError.

        dtype: network dtype; None: as checkpoint and device decide
        cache: frame feature cache, if ``Description.keeps_features``; None: no cache
        """

    def save(self, folder: Path) -> None:
        """Write everything except the encoders into a new folder, which ``Family.restore`` reads."""


@dataclass(frozen=True)
class Family:
    """A checkpoint family, as it is served.

    name: the package with this object as its ``FAMILY``
    restore: loads what ``Checkpoint.save`` wrote into a folder; raises CheckpointError
    reader: the module whose ``READER`` reads checkpoints as they were published, which serving never imports
    encoders: the family's encoder class; None: its checkpoints score raw frames
    """

    name: str
    restore: Callable[[Path], Checkpoint]
    reader: str
    encoders: type[FrameEncoders] | None = None
