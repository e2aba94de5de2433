# SPDX-License-Identifier: MIT
"""Reward models that write an answer about separate images, such as Robo-Dopamine.

L tokens. A model gives its settings, the images of each question, the text around them, and the reading of an answer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import numpy as np
import torch

from rfm.checkpoint.content import NETWORK_CONFIG, CheckpointError, is_there, read_json
from rfm.checkpoint.run_config import find_run_config
from rfm.engine.feature_cache import FeatureCache
from rfm.family import Family, Options
from rfm.vlm.collator import IMAGE_PAD, VISION_END, VISION_START, expanded
from rfm.vlm.images import MERGE
from rfm.vlm.language import LanguageCheckpoint, LanguageNetwork
from rfm.vlm.language_folder import ONLY_QWEN3, LanguageFolder, reward_model_of
from rfm.vlm.preprocessor import pixel_limits
from rfm.vlm.processor import read_processor
from rfm.vlm.qwen import Box, Indices, positions
from rfm.vlm.row import VlmRow
from rfm.vlm.video import VlmVideo
from rfm.vlm.written import WritingCollator, WritingConfig, WritingPredictor, is_named, stops_of
from rfm_client.contract import InvalidSampleError
from rfm_client.contract.description import Description
from rfm_client.contract.samples import UInt8Array

if TYPE_CHECKING:
    from typing_extensions import Self

IMAGE = VISION_START + IMAGE_PAD + VISION_END
PLACEHOLDER = "<image>"  # of an image in the originals' prompts
Images: TypeAlias = Sequence[tuple[VlmVideo, int]]  # video and index of each image, in the prompt's order


@dataclass(frozen=True)
class ImagesConfig(WritingConfig):
    """The configuration of a model that is asked about images."""

    multi_image: ClassVar[bool] = True

    def check(self) -> None:
        """Raise CheckpointError for a setting of the user that makes no sense."""
        if self.max_new_tokens < 1:
            raise CheckpointError.at("--as: max_new_tokens", "at least 1", self.max_new_tokens)


@dataclass(frozen=True, eq=False)
class ImagesRow(VlmRow):
    """A question about images."""

    images: Images = field(kw_only=True)

    @property
    def shown(self) -> Iterator[tuple[VlmVideo, Indices]]:
        """Each image's video, and its index there."""
        return ((video, np.array([frame])) for video, frame in self.images)


class ImagesCollator(WritingCollator):
    """The collator of questions about images."""

    num_images: ClassVar[int]  # of a question

    def check_template(self) -> None:
        """Raise CheckpointError unless a prompt has its images."""
        got = self.example().count(IMAGE)
        if got != self.num_images:
            raise CheckpointError.at("chat template", f"{self.num_images} images in a prompt", got)

    def num_patches(self, video: VlmVideo) -> int:
        """Return the number of patches of a video's frames that are shown."""
        return super().num_patches(video) * len(video.conversations)

    def rendered(self, parts: Sequence[str | None]) -> str:
        """Return the chat template's text of a question. parts: texts; None: an image"""
        content = [{"type": "image"} if part is None else {"type": "text", "text": part} for part in parts]
        conversation = [{"role": "user", "content": content}]
        return str(self.tokenizer.apply_chat_template(conversation, tokenize=False, add_generation_prompt=True))

    def questions(self, text: str, asked: Sequence[Images]) -> list[VlmRow]:
        """Return the rows of questions whose images have equal sizes, so that they have equal tokens.

        text: the chat template's
        """
        grids = [self.grid(video) for video, _ in asked[0]]
        ids = expanded(self._chat.tokens(text), self.visual_pad, [grid.tokens_per_group for grid in grids])
        starts = self._positions(ids, VISION_START) + 1
        boxes = [
            Box(int(start), 1, grid.rows // MERGE, grid.columns // MERGE)
            for start, grid in zip(starts, grids, strict=True)
        ]
        at = positions(len(ids), boxes)
        return [
            ImagesRow(ids, _different(images), ([],), len(ids) - 1, False, position_ids=at, images=images)
            for images in asked
        ]

    def _check_task(self, task: str) -> None:
        super()._check_task(task)
        if PLACEHOLDER in task:
            raise InvalidSampleError.at("task", f"text without {PLACEHOLDER}", repr(task))


def _different(images: Images) -> tuple[VlmVideo, ...]:
    return tuple(dict.fromkeys(video for video, _ in images))


def each_alone(frames: Sequence[UInt8Array] | UInt8Array, shown: Indices, named: Any = None) -> VlmVideo:
    """Return a video of which each frame in ``shown``, int64 [N], is an image. named: as in ``VlmVideo``"""
    return VlmVideo(frames, 1, [np.array([frame]) for frame in shown], named)


@dataclass(frozen=True)
class ImagesCheckpoint(LanguageCheckpoint):
    """A checkpoint of a model that is asked about images.

    made_of: class of the configuration
    made_for: class of the predictor
    backbones: as in ``LanguageFolder.read``
    of_user: type of each setting that ``--as`` takes
    is_bounded: the processor's limits of an image are settings: ``least_px`` and ``most_px``
    """

    made_of: ClassVar[type[ImagesConfig]]
    made_for: ClassVar[type[WritingPredictor]]
    backbones: ClassVar[Mapping[str, str]] = ONLY_QWEN3
    of_user: ClassVar[Mapping[str, type]] = {}
    is_bounded: ClassVar[bool] = False
    reads_videos: ClassVar[bool] = False

    @property
    def description(self) -> Description:
        """The model's inputs and outputs."""
        return Description(
            network={"class": LanguageNetwork.__name__},
            may_not_answer=True,
            asks_in_words=True,
            keeps_features=True,
            is_large=True,
        )

    def make_predictor(
        self, network: LanguageNetwork, device: torch.device, cache: FeatureCache[Any] | None
    ) -> WritingPredictor:
        """Return the predictor with this network."""
        return self.made_for(network, self.collator, device, cache)

    @classmethod
    def family(cls, package: str) -> Family:
        """Return the family of these checkpoints."""
        return Family(name=package, reads=cls.reads, load=cls.load, reward_models=(cls.made_of.reward_model,))

    @classmethod
    def reads(cls, folder: Path) -> bool:
        """True if a folder holds an export of this model, or a Qwen-VL of its name without a run's config.yaml."""
        name = cls.made_of.reward_model
        if reward_model_of(folder) is not None:
            return reward_model_of(folder) == name
        content = read_json(folder / NETWORK_CONFIG) if is_there(folder / NETWORK_CONFIG) else {}
        return is_named(folder, name) and content.get("model_type") in cls.backbones and find_run_config(folder) is None

    @classmethod
    def load(cls, folder: Path, options: Options) -> Self:
        """Load the model of a local folder: a Qwen-VL's, or an export. Raises CheckpointError."""
        if options.video_prompt is not None:
            expected = "none: the prompt of this checkpoint has images"
            raise CheckpointError.at("--video-prompt", expected, options.video_prompt)
        given = options.settings(cls.of_user)
        files = LanguageFolder.read(folder, options, cls.backbones)
        config = files.saved(cls.made_of)
        if config is None:
            limits = _limits(files) if cls.is_bounded else {}
            config = cls.made_of(**{**files.made_of, **limits}, stops=stops_of(folder))
        config = replace(config, **given)
        config.check()
        checkpoint = cls(config, files.weights, files.processor, files.assumptions(config))
        checkpoint.check()
        return checkpoint


def _limits(files: LanguageFolder) -> dict[str, int]:
    _, preprocessor = read_processor(files.processor)
    return pixel_limits(preprocessor, f"base model {files.processor}")
