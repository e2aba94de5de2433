# SPDX-License-Identifier: MIT
"""An ordinary Qwen-VL with its language head, for reward models that are prompted in words.

B conversations, L tokens, width D, V rows in the language head, Q queries: tokens whose successor is predicted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from rfm.engine.graphs import Graphs
from rfm.engine.layers import Normalisation
from rfm.engine.predictor import check_type
from rfm.files import NETWORK_CONFIG, CheckpointError, expecting, shown
from rfm.qwen.backbone import Box, KeyValues, positions
from rfm.qwen.batch import VlmBatch, VlmRow
from rfm.qwen.checkpoint import QwenCheckpoint
from rfm.qwen.collator import VIDEO_PAD, VISION_END, VISION_START, QwenCollator, expanded, timed_groups, video_of
from rfm.qwen.images import MERGE, BoundedImages, QwenImages
from rfm.qwen.network import BackboneConfig, qwen_states
from rfm.qwen.processor import (
    SIZED_BY_PROCESSOR,
    check_tokens,
    normalisation_of,
    patch_px,
    read_processor,
)
from rfm.qwen.video import Indices, VlmVideo
from rfm.saved import REWARD_MODEL, Saved
from rfm_client.contract import ProgressSample, Sample
from rfm_client.contract.description import Description

if TYPE_CHECKING:
    from typing_extensions import Self


VIDEO = VISION_START + VIDEO_PAD + VISION_END  # a video, or a temporal patch, in a prompt's text
HEAD, EMBEDDING = "lm_head.weight", "model.language_model.embed_tokens.weight"


@dataclass(frozen=True)
class LanguageConfig(BackboneConfig):
    """The configuration of a Qwen3-VL that is prompted in words.

    base_model_id: source of the network, its tokenizer and processor
    """

    base_model_id: str

    reward_model: ClassVar[str]  # in an exported config.json
    multi_image: ClassVar[bool] = False
    has_preference: ClassVar[bool] = False
    has_success: ClassVar[bool] = False
    has_similarity: ClassVar[bool] = False

    @classmethod
    def of(cls, saved: Saved) -> Self:
        """Return the configuration in an export. Raises CheckpointError for another reward model's export."""
        file = saved.folder / NETWORK_CONFIG
        fields = {name: tuple(each) if isinstance(each, list) else each for name, each in saved.settings.items()}
        name = fields.pop(REWARD_MODEL, None)
        if name != cls.reward_model:
            raise CheckpointError.at(saved.folder, f"an export of {cls.reward_model}", f"one of {shown(name)}")
        with expecting(f"the settings of an export of {cls.reward_model}", file):
            return cls(backbone=saved.backbone, **cls.fields_of(fields))

    @classmethod
    def fields_of(cls, settings: dict[str, Any]) -> dict[str, Any]:
        """Return this class's fields from an export's settings."""
        return settings


@dataclass(frozen=True)
class LanguageOutput:
    """Logits for the token behind each query, [Q, V], and the features that the vision tower computed."""

    logits: Tensor
    made: Tensor | None


class LanguageNetwork(nn.Module):
    """The backbone and its language head."""

    graphs: Graphs | None = None

    def __init__(self, config: LanguageConfig, backbone: nn.Module) -> None:
        super().__init__()
        self.config = config
        self.model: Any = backbone
        self.lm_head = nn.Linear(config.hidden_dim, config.backbone["text_config"]["vocab_size"], bias=False)

    def forward(self, batch: VlmBatch, key_values: KeyValues | None = None) -> LanguageOutput:
        """Return the logits for the token behind each query in a batch on the network's device.

        key_values: receives the keys and values of all tokens
        """
        hidden, made = qwen_states(self.model, batch, key_values, self.graphs)
        return LanguageOutput(self.lm_head(hidden[batch.queries]), made)


class LanguageCollator(QwenCollator):
    """The collator for prompts with one video, every temporal patch behind its time."""

    kept_tokens = 4096  # pieces of prompts, and times

    def check_template(self) -> None:
        """Raise CheckpointError unless a prompt has its video once."""
        num_videos = self.example().count(VIDEO)
        if num_videos != 1:
            raise CheckpointError.at("chat template", "one video in a prompt", num_videos)

    def example(self) -> str:
        """Return the prompt for an example task, with VIDEO as placeholder."""
        raise NotImplementedError

    def rows(self, sample: Sample) -> list[VlmRow]:
        """Return the conversations for a progress sample. Raises InvalidSampleError."""
        check_type(sample, self.config)
        assert isinstance(sample, ProgressSample)  # by check_type
        (trajectory,) = sample.trajectories
        self._check_task(trajectory.task)
        return self.prompts(video_of(trajectory, sample.frame_steps), trajectory.task)

    def prompts(self, video: VlmVideo, task: str) -> list[VlmRow]:
        """Return the conversations about a video. Raises InvalidSampleError for frames that cannot be resized."""
        raise NotImplementedError

    def row(
        self, video: VlmVideo, text: str, shown: Indices, times_s: Sequence[float], more: Indices | tuple[int, ...] = ()
    ) -> VlmRow:
        """Return the conversation in which a video replaces VIDEO in ``text``.

        shown: indices of its frames, int64
        times_s: one per temporal patch
        more: tokens behind the text
        """
        grid = self.grid(video)
        before, _, behind = text.partition(VIDEO)
        first, *others = self._around(*(timed_groups([time_s]) for time_s in times_s))
        # All pieces but the last end with a special token, so tokenising them separately gives the text's own tokens.
        pieces = [before + first, *others, behind]
        tokens = np.concatenate([*map(self._chat.tokens, pieces), more]).astype(np.int64)
        pad = self.tokenizer.convert_tokens_to_ids(VIDEO_PAD)
        ids = expanded(tokens, pad, [grid.tokens_per_group] * len(times_s))
        starts = self._positions(ids, VISION_START) + 1
        starts = starts[ids[starts] == pad]
        boxes = [Box(int(start), 1, grid.rows // MERGE, grid.columns // MERGE) for start in starts]
        return VlmRow(ids, (video,), ([],), len(ids) - 1, False, picked=shown, position_ids=positions(len(ids), boxes))

    def template(self, *content: str, add_generation_prompt: bool) -> str:
        """Return the chat template's text for one user message: the video, then ``content``."""
        parts = [{"type": "video"}, *({"type": "text", "text": text} for text in content)]
        return str(
            self.tokenizer.apply_chat_template(
                [{"role": "user", "content": parts}], tokenize=False, add_generation_prompt=add_generation_prompt
            )
        )


@dataclass(frozen=True)
class LanguageCheckpoint(QwenCheckpoint):
    """A Qwen3-VL in memory that is prompted in words.

    weights: for LanguageNetwork; with the head only if it is not tied to the embedding
    made_of, collator_of: the classes of the configuration and the collator
    """

    made_of: ClassVar[type[LanguageConfig]]
    collator_of: ClassVar[Any]
    network_of: ClassVar[Any] = LanguageNetwork
    reads_videos: ClassVar[bool] = True  # otherwise separate images
    has_language_head: ClassVar[bool] = True

    @property
    def own_tokens(self) -> dict[str, int]:
        """Tokens that an ordinary Qwen3-VL lacks, with their ids."""
        return {}

    @classmethod
    def restore(cls, folder: Path) -> Self:
        """Load what ``save`` wrote. Raises CheckpointError."""
        saved = Saved.read(folder)
        checkpoint = cls(cls.made_of.of(saved), saved.weights, saved.processor)
        checkpoint.check()
        return checkpoint

    def load_collator(self) -> LanguageCollator:
        tokenizer, preprocessor = read_processor(self.processor, videos=self.reads_videos)
        num_rows = self.config.backbone["text_config"]["vocab_size"]
        if len(tokenizer) > num_rows:
            expected = f"a tokenizer of at most {num_rows} tokens, as the embedding"
            raise CheckpointError.at(f"base model {self.processor}", expected, len(tokenizer))
        check_tokens(self.config, tokenizer, self.processor, self.own_tokens)
        where = f"base model {self.processor}: preprocessing of {'videos' if self.reads_videos else 'images'}"
        if not self.reads_videos:  # for images, ``pixel_limits`` reads these
            preprocessor = {**preprocessor, "min_pixels": None, "max_pixels": None}
        normalisation = normalisation_of(preprocessor, SIZED_BY_PROCESSOR, where)
        patch = patch_px(preprocessor, self.config.backbone["vision_config"], where)
        collator: LanguageCollator = self.collator_of(self.config, tokenizer, self.images(patch, normalisation))
        collator.check_template()
        return collator

    def loaded(self, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the weights with the embedding as the language head, if the head is tied to it."""
        is_tied = self.has_language_head and HEAD not in weights and EMBEDDING in weights
        return {**weights, **({HEAD: weights[EMBEDDING]} if is_tied else {})}

    def saved_settings(self) -> dict[str, Any]:
        return {REWARD_MODEL: self.config.reward_model, **super().saved_settings()}

    def build(self, dtype: torch.dtype | None = None) -> Any:
        """Return the network with these weights, on the CPU, in ``dtype`` (None: its own). Raises CheckpointError."""
        network = super().build(dtype)
        if self.has_language_head and HEAD not in self.weights:
            network.lm_head.weight = network.model.language_model.embed_tokens.weight
        return network

    def images(self, patch_px: int, normalisation: Normalisation) -> QwenImages:
        """Return the preprocessing; by default that of separate images whose pixels the configuration bounds."""
        return BoundedImages(patch_px, normalisation, least_px=self.config.least_px, most_px=self.config.most_px)

    def described(self, kind: str, **facts: Any) -> Description:
        """Return the description of a model of this kind. facts: what not all such models have in common"""
        network = {"class": self.network_of.__name__}
        return Description(kind=kind, network=network, asks_in_words=True, keeps_features=True, is_large=True, **facts)
