# SPDX-License-Identifier: MIT
"""Turn samples of raw frames into rows, and rows into padded batches for a vision-language backbone.

T frames, L tokens. A row is a conversation plus the tokens whose hidden states are read for the frames and the query.
Making a row is cheap. Resizing its frames is not, and may happen before its batch is collated.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from enum import Enum
from functools import lru_cache, partial
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from rfm.engine.feature_cache import FeatureCache
from rfm.engine.layers import concatenated
from rfm.engine.predictor import prefix_indices
from rfm.engine.threads import IN_TURN, FrameThreads
from rfm.qwen.backbone import Box, plan, positions
from rfm.qwen.batch import QwenPixels, Shots, VlmBatch, VlmRow
from rfm.qwen.images import FRAMES_PER_GROUP, MERGE, Grid, QwenImages
from rfm.qwen.leaves import Leaf, Packs, PlacedPack, calls, padded
from rfm.qwen.network import QWEN3, WRAPPED
from rfm.qwen.video import Indices, Shot, SizedFrames, VlmVideo
from rfm_client.contract import InvalidSampleError, Sample, Trajectory

KEPT_TEXTS = 256  # cached conversations; an RL loop repeats the same task
MAX_KEPT_BYTES = 16_384  # per conversation text; a task and 128 frames have fewer. A byte is at most one token
FRAME_BYTES = 64  # chat template text per frame, about


class Visual(Enum):
    """The non-text parts of a chat template, by name."""

    IMAGE = "image"
    VIDEO = "video"


class Chat:
    """A base model's chat template and tokenizer, with a cache of recent short conversations."""

    def __init__(self, tokenizer: Any, kept_tokens: int = KEPT_TEXTS) -> None:
        self._tokenizer = tokenizer
        self._text = lru_cache(KEPT_TEXTS)(self._render)
        self._tokens = lru_cache(kept_tokens)(self._tokenise)

    def text(self, parts: tuple[str | Visual, ...]) -> str:
        """Return the chat template's text for one user message."""
        is_short = sum(_num_bytes(part) if isinstance(part, str) else FRAME_BYTES for part in parts) <= MAX_KEPT_BYTES
        return (self._text if is_short else self._render)(parts)

    def tokens(self, text: str) -> Indices:
        """Return the text's tokens, int64 [L], read-only."""
        return (self._tokens if _num_bytes(text) <= MAX_KEPT_BYTES else self._tokenise)(text)

    def _render(self, parts: tuple[str | Visual, ...]) -> str:
        content = [{"type": "text", "text": part} if isinstance(part, str) else {"type": part.value} for part in parts]
        conversation = [{"role": "user", "content": content}]
        return str(self._tokenizer.apply_chat_template(conversation, tokenize=False, add_vision_id=True))

    def _tokenise(self, text: str) -> Indices:
        ids = np.asarray(self._tokenizer(text, add_special_tokens=False, verbose=False)["input_ids"], np.int64)
        ids.setflags(write=False)
        return ids


def _num_bytes(text: str) -> int:
    return len(text.encode(errors="surrogatepass"))


SECONDS_PER_GROUP = 1  # upstream's value for videos of Qwen2.5-VL
TOKENS_PER_SECOND = 4  # transformers' default for Qwen2.5-VL
VIDEO_FPS = 1  # upstream's value for Qwen3-VL, whose prompt states the time for each temporal patch
VISION_START, VISION_END = "<|vision_start|>", "<|vision_end|>"
IMAGE_PAD, VIDEO_PAD = "<|image_pad|>", "<|video_pad|>"


class QwenCollator:
    """Turns samples into rows, and rows into batches, for Qwen2.5-VL and Qwen3-VL. A family implements ``rows``.

    Images and videos are pad tokens between vision start and end.

    tokenizer: the base model's, with the checkpoint's special tokens and a chat template
    images: the backbone's preprocessing
    """

    makes_trees: ClassVar[bool] = True  # compute the shared beginnings of prefixes once
    kept_tokens: ClassVar[int] = KEPT_TEXTS  # texts whose tokens are cached: whole conversations

    def __init__(self, config: Any, tokenizer: Any, images: QwenImages) -> None:
        self.config = config
        self.tokenizer = tokenizer
        self.images = images
        self._special_tokens = tuple(tokenizer.get_added_vocab())
        self._chat = Chat(tokenizer, self.kept_tokens)

    @property
    def frames_per_shot(self) -> int:
        """How many frames a temporal patch has."""
        return 1 if self.config.multi_image else FRAMES_PER_GROUP

    def rows(self, sample: Sample) -> list[VlmRow]:
        """Return a sample's conversations. Raises InvalidSampleError if the checkpoint cannot score the sample."""
        raise NotImplementedError

    def collate(self, rows: Sequence[VlmRow], length: int | None = None) -> VlmBatch:
        """Return a batch of conversations, whatever their kinds and lengths, whose frames have been resized.

        length: L, the padded length; None: the longest conversation's
        """
        length = length or max(row.num_tokens for row in rows)
        ids = torch.full((len(rows), length), self.tokenizer.pad_token_id, dtype=torch.int64)
        position_ids = torch.zeros(3, *ids.shape, dtype=torch.int64)
        for index, row in enumerate(rows):
            ids[index, : row.num_tokens] = torch.from_numpy(row.input_ids)
            position_ids[:, index, : row.num_tokens] = torch.from_numpy(row.position_ids)
        shots = Shots(are_images=self.config.multi_image)
        read = [shots.add(video, shown) for row in rows for video, shown in row.shown]
        read_by = {leaf: shots.add(row.videos[0], leaf.shown) for row in rows for leaf in row.leaves}
        grids = [each.grid(self.images) for each in shots.sizes]
        layout = shots.layout([grid.tokens_per_group for grid in grids])
        packs, first = self._packs(rows, ids.numel(), lambda leaf: layout.tokens(read_by[leaf]))
        spans, queries = list[tuple[int, int]](), list[int]()
        for index, row in enumerate(rows):
            reads = [(first[leaf] + leaf.reads[0], first[leaf] + leaf.reads[1]) for leaf in row.leaves]
            own = [(index * length + start, index * length + stop) for each in row.spans for start, stop in each]
            spans += own if row.query is not None else [*reads, *own]
            queries += [] if row.query is None else [*(start for start, _ in reads), index * length + row.query]
        return VlmBatch(
            inputs={
                "input_ids": ids,
                "position_ids": position_ids,
                "visual_tokens": (ids.flatten() == self.visual_pad).nonzero()[:, 0],
                "visual_features": torch.from_numpy(np.concatenate([layout.tokens(keys) for keys in read])),
            },
            spans=torch.tensor(spans, dtype=torch.int64).reshape(-1, 2),
            queries=torch.tensor(queries, dtype=torch.int64),
            num_tokens=sum(row.cost for row in rows),
            num_span_tokens=sum(stop - start for start, stop in spans),
            pixels=QwenPixels(
                self.images, [each.videos for each in shots.sizes], [each.indices() for each in shots.sizes]
            ),
            plan=plan(grids, self.config.backbone["vision_config"]) if grids else None,
            layout=layout,
            packs=packs,
        )

    def _packs(
        self, rows: Sequence[VlmRow], num_slots: int, features: Callable[[Leaf], Indices]
    ) -> tuple[tuple[Packs, ...], dict[Leaf, int]]:
        """Return the packs of all rows, call by call, and each leaf's first token among all tokens in the batch.

        num_slots: B * L
        features: returns the feature indices that a leaf's whole conversation shows
        """
        packs = [PlacedPack(index, row.num_tokens, pack) for index, row in enumerate(rows) for pack in row.packs]
        made, first = [], dict[Leaf, int]()
        for call in calls(packs):
            of_call, starts = padded(call, self.tokenizer.pad_token_id, self.visual_pad, features)
            made.append(of_call)
            first |= {leaf: num_slots + start for leaf, start in starts.items()}
            num_slots += of_call.input_ids.numel()
        return tuple(made), first

    def _positions(self, ids: Indices, token: str) -> Indices:
        return np.flatnonzero(ids == self.tokenizer.convert_tokens_to_ids(token))

    def _check_task(self, task: str) -> None:
        """Raise InvalidSampleError for an empty task or special tokens in it: a task is data."""
        if not task.strip():
            raise InvalidSampleError.at("task", "a task sentence", repr(task))
        for token in self._special_tokens:
            if token in task:
                raise InvalidSampleError.at("task", "text without the model's special tokens", repr(token))

    def to_size(
        self, video: VlmVideo, cache: FeatureCache[Any] | None = None, threads: FrameThreads = IN_TURN
    ) -> SizedFrames:
        """Resize the frames of a video's shots for the backbone.

        cache: frames whose shots it holds need no resizing; None: no cache
        threads: prepare the frames
        """
        keys: dict[Shot, Hashable]
        if cache is None:
            keys = {shot: (id(video), shot) for shot in video.shots(are_images=self.config.multi_image)}
            kept, alike = {}, np.arange(len(video.frames))
        else:
            video.compute_digests(threads)
            keys = self.shot_keys(video)
            found = cache.found(keys.values())
            kept = {key: found[key] for shot, key in keys.items() if key in found and not video.is_blank(shot)}
            alike = video.alike
        needed = sorted({int(alike[frame]) for shot, key in keys.items() if key not in kept for frame in shot})
        places = np.full(len(video.frames), -1)
        places[needed] = np.arange(len(needed))
        pixels = concatenated(threads.parts(partial(self._to_size, video), needed))
        return SizedFrames(pixels, places[alike], keys, kept)

    def shot_keys(self, video: VlmVideo) -> dict[Shot, Hashable]:
        """Return the shots' keys: size and frame digests, which alone determine a shot's features."""
        grid, digests = self.grid(video), video.digests
        shots = video.shots(are_images=self.config.multi_image)
        return {shot: (grid.rows, grid.columns, *(digests[frame] for frame in shot)) for shot in shots}

    def _to_size(self, video: VlmVideo, needed: Sequence[int]) -> Tensor:
        """Resize the needed video frames independently to uint8 [N, H', W', 3]. Thread-safe."""
        frames = video.stack(needed)
        if self.config.multi_image:
            return self.images.images_to_size(frames)
        return self.images.video_to_size(frames, video.num_shown)

    @property
    def _pad(self) -> str:
        return IMAGE_PAD if self.config.multi_image else VIDEO_PAD

    @property
    def visual_pad(self) -> int:
        """The token whose embedding is replaced by visual features."""
        return int(self.tokenizer.convert_tokens_to_ids(self._pad))

    def grid(self, video: VlmVideo) -> Grid:
        """Return the grid for the video frames that a conversation shows, as images or as a video."""
        if self.config.multi_image:
            return replace(self.images.image_grid(*video.size), groups=video.num_shown)
        return self.images.video_grid(*video.size, video.num_shown)

    def num_patches(self, video: VlmVideo) -> int:
        """Return how many patches the longest conversation's frames have."""
        grid = self.grid(video)
        return grid.groups * grid.rows * grid.columns

    def _around(self, *texts: str) -> tuple[str, ...]:
        """Return a Qwen3-VL's video texts in its prompt's form, wrapped as a whole or bare."""
        return (VISION_START, *texts, VISION_END) if self.config.video_prompt == WRAPPED else texts

    def _position_ids(self, ids: Indices, videos: tuple[VlmVideo, ...]) -> Indices:
        """Return position ids: one box per image, per temporal patch (Qwen3-VL) or per video (Qwen2.5-VL)."""
        is_whole = not self.config.multi_image and self.config.family != QWEN3
        step = SECONDS_PER_GROUP * self.config.backbone["vision_config"].get("tokens_per_second", TOKENS_PER_SECOND)
        boxes, read, starts = [], 0, self._positions(ids, self._pad)
        for grid in map(self.grid, videos):
            groups = grid.groups if is_whole else 1
            for _ in range(grid.groups // groups):
                boxes.append(Box(int(starts[read]), groups, grid.rows // MERGE, grid.columns // MERGE, step))
                read += boxes[-1].num_tokens
        return positions(len(ids), boxes)


def video_of(trajectory: Trajectory, frame_steps: int) -> VlmVideo:
    """Return a trajectory's frames as a video. Raises InvalidSampleError for embeddings.

    frame_steps: for dense mode; 0: one conversation with all frames
    """
    frames: Any = trajectory.frames
    digests = None
    if trajectory.named is not None:
        digests, frames = zip(*trajectory.named, strict=True)
    if frames is None:
        raise InvalidSampleError.at("video_embeddings", "frames (this checkpoint reads raw frames)", "embeddings")
    count = len(frames)
    conversations = list(prefix_indices(count, frame_steps)) if frame_steps else [np.arange(count)]
    return VlmVideo(frames, frame_steps or count, conversations, digests)


def expanded(ids: Indices, pad: int, lengths: Sequence[int]) -> Indices:
    """Repeat the ``pad`` tokens by ``lengths``, which is faster than tokenising the repeated text."""
    times = np.ones(len(ids), np.int64)
    at = np.flatnonzero(ids == pad)
    assert len(at) == len(lengths), "the chat template shows each image or video once"
    times[at] = lengths
    return ids.repeat(times)


def group_times(num_groups: int) -> list[float]:
    """Return the mean frame time of every temporal patch, in seconds, at VIDEO_FPS."""
    frame_times = [
        [(group * FRAMES_PER_GROUP + frame) / VIDEO_FPS for frame in range(FRAMES_PER_GROUP)]
        for group in range(num_groups)
    ]
    return [sum(times) / FRAMES_PER_GROUP for times in frame_times]


def timed_groups(times_s: Sequence[float]) -> str:
    """Return Qwen3-VL's text for a video: every temporal patch behind its time."""
    return "".join(f"<{time_s:.1f} seconds>{VISION_START}{VIDEO_PAD}{VISION_END}" for time_s in times_s)
