# SPDX-License-Identifier: MIT
"""The interface of a family of checkpoints to the engine and the export. A family is a package with a ``FAMILY``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from rfm.checkpoint.content import CheckpointError
from rfm.checkpoint.provenance import Assumption
from rfm.config import ExportConfig
from rfm.config import VideoPrompt as VideoPrompt
from rfm.config import Weights as Weights
from rfm_client.contract import RewardError, Sample
from rfm_client.contract.description import Description
from rfm_client.contract.samples import EncoderSample, Float32Array

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

    from rfm.engine.execution import Execution
    from rfm.engine.feature_cache import FeatureCache
    from rfm.engine.predictor import Predictor

NETWORK = "network"  # key in Checkpoint.parts: the weights of the network that scores
# Fields of networks' configurations that are newer than some exports, with the value of those exports.
_USUAL = {"has_preference": True, "has_success": True, "video_prompt": "bare", "strict_answers": False, "weights": None}
# Options, with the checkpoints that support them.
_FOLLOWED_BY = {
    "video_prompt": "a checkpoint that shows videos to a Qwen3-VL",
    "strict_answers": "a RoboReward that writes its answers",
    "weights": "a vision-language checkpoint whose weights are not rounded (other networks are small)",
    **dict.fromkeys(("robot_description", "camera_description"), "a RynnValue whose prompt names robot and camera"),
}


@dataclass(frozen=True)
class Options:
    """The user's options for files that a checkpoint lacks. Each family reads its own fields.

    base_model: folder or id of a vision-language checkpoint's base model; None: as the checkpoint names it
    image_encoder, text_encoder: folders or ids of a ReWiND checkpoint's encoders; None: upstream's, if the checkpoint
        has weights of encoders or the other is set
    reward_model: the way in which an ordinary vision-language model is asked, ``name,setting=value,...``; None: the
        checkpoint is a reward model
    video_prompt: form of a Qwen3-VL's video prompt; None: as the checkpoint's ``transformers_version`` tells
    strict_answers: refuse an unclear written answer; False: mark it
    weights: round the weights of a vision-language network's layers; None: as in the checkpoint
    robot_description, camera_description: words for the robot and the camera in RynnValue's prompt; None: not named
    """

    base_model: str | None = None
    image_encoder: str | None = None
    text_encoder: str | None = None
    reward_model: str | None = None
    video_prompt: VideoPrompt | None = None
    strict_answers: bool = False
    weights: Weights | None = None
    robot_description: str | None = None
    camera_description: str | None = None

    @classmethod
    def of(cls, settings: ExportConfig) -> Options:
        """Return the options among an export's settings, which have the same names."""
        return cls(**{each.name: getattr(settings, each.name) for each in fields(cls)})

    def check_used(self, config: Any) -> None:
        """Raise CheckpointError for an option that the network does not support."""
        for name, expected in _FOLLOWED_BY.items():
            wanted = getattr(self, name)
            if wanted and getattr(config, name, None) != wanted:
                flag, mend = f"--{name.replace('_', '-')}", "leave it out, or export the checkpoint again"
                raise CheckpointError.at(flag, expected, "another checkpoint", mend)

    def named(self) -> tuple[str | None, dict[str, str]]:
        """Return the reward model's name and the user's settings of it, from ``name,setting=value,...``.

        Raises CheckpointError.
        """
        if self.reward_model is None:
            return None, {}
        name, *settings = self.reward_model.split(",")
        if wrong := [setting for setting in settings if setting.count("=") != 1]:
            raise CheckpointError.at("--as", "setting=value", repr(wrong[0]))
        return name, dict(setting.split("=") for setting in settings)

    def settings(self, known: Mapping[str, type]) -> dict[str, Any]:
        """Return the user's settings as numbers or booleans. Raises CheckpointError if one is unknown or wrong.

        known: type of each setting
        """
        return {name: _value(name, text, known) for name, text in self.named()[1].items()}


def _value(name: str, text: str, known: Mapping[str, type]) -> Any:
    if name not in known:
        expected = f"settings among {', '.join(known)}" if known else "no settings of this reward model"
        raise CheckpointError.at("--as", expected, repr(name))
    try:
        return {"true": True, "false": False}[text] if known[name] is bool else known[name](text)
    except (KeyError, ValueError):
        raise CheckpointError.at(f"--as: {name}", f"a value of type {known[name].__name__}", repr(text)) from None


def config_fields(config: Any) -> dict[str, Any]:
    """Return the fields of a network's configuration, as in files and digests.

    Newer fields are left out if they have the value of older exports, so that older files and digests stay valid.
    """
    return {name: value for name, value in asdict(config).items() if name not in _USUAL or value != _USUAL[name]}


class FrameEncoders(Protocol):
    """Networks that turn raw frames and a task into embeddings for a checkpoint."""

    @classmethod
    def load(cls, folder: Path) -> FrameEncoders:
        """Load the encoders that ``save`` wrote into ``folder``."""

    @classmethod
    def describe(cls, folder: Path) -> Description:
        """Return the description of the encoders that ``save`` wrote into ``folder``, without loading them."""

    @property
    def description(self) -> Description:
        """Network and frame size of these encoders."""

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
        """Return each sample with embeddings of its frames and task, or its error.

        execution: the costs are added to it
        cache: of embeddings; None: no cache, and no samples with named frames
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
        """Return the floating-point operations to score a sample: about two for each parameter that a token passes.

        Raises CheckpointError, and InvalidSampleError if this checkpoint cannot score the sample.
        """

    def predictor(
        self, device: torch.device, dtype: torch.dtype | None = None, cache: FeatureCache[Any] | None = None
    ) -> Predictor[Any, Any]:
        """Return a predictor with the checkpoint's network on ``device``. Raises CheckpointError.

        dtype: of the network; None: as checkpoint and device decide
        cache: for features of frames, if ``Description.keeps_features``; None: no cache
        """

    def save(self, folder: Path) -> None:
        """Write all but the encoders into a new folder, which ``Family.restore`` reads."""


@dataclass(frozen=True)
class Family:
    """A family of checkpoints, as it is served.

    name: the package with this object as its ``FAMILY``
    restore: loads what ``Checkpoint.save`` wrote into a folder; raises CheckpointError
    reader: the module whose ``READER`` reads checkpoints as they were published, which serving never imports
    encoders: the class of the family's encoders; None: its checkpoints score raw frames
    """

    name: str
    restore: Callable[[Path], Checkpoint]
    reader: str
    encoders: type[FrameEncoders] | None = None


@dataclass(frozen=True)
class Loaded:
    """A checkpoint as it was published, and what a user must know about it.

    assumptions: the settings that neither weights nor files prove
    notes: returns a line for the user about each contradiction to the known facts of training; raises CheckpointError
    encoders: returns the checkpoint's encoders, or None; raises CheckpointError if they are missing or do not fit
    """

    checkpoint: Checkpoint
    assumptions: Sequence[Assumption] = ()
    notes: Callable[[], Sequence[str]] = list
    encoders: Callable[[], FrameEncoders | None] = lambda: None


@dataclass(frozen=True)
class Reader:
    """Reads the checkpoints of a family as they were published, or as they were exported.

    reads: returns True if a folder may hold a checkpoint of the family; used if the caller names no family
    load: loads the checkpoint of a local folder; raises CheckpointError
    reward_models: names that ``--as`` takes, for ordinary models that the family asks in its own way
    """

    reads: Callable[[Path], bool]
    load: Callable[[Path, Options], Loaded]
    reward_models: tuple[str, ...] = ()
