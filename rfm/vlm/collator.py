# SPDX-License-Identifier: MIT
"""Samples of raw frames -> rows -> padded batches for a vision-language backbone.

B rows, T frames, L tokens. A row is one conversation: its tokens, and where in them each frame's and the
question's hidden states are read. Token ids are those of the original inference collator, sample for sample.
Reading a row is cheap; its pixels are made when its batch is collated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from rfm.dense_mode import prefix_indices
from rfm.vlm.images import FRAMES_PER_GROUP, Grid, QwenImages, SmolImages
from rfm.vlm.network import VlmBatch, VlmConfig
from rfm.vlm.prompts import PREFERENCE_TOKEN, PROGRESS_TOKEN, SIMILARITY_TOKEN, TrajectoryPart, question
from rfm_client.contract import InvalidSampleError, ProgressSample, Sample, SimilaritySample, Trajectory
from rfm_client.contract.samples import UInt8Array

TEXT, IMAGE, VIDEO = 0, 1, 2  # values of mm_token_type_ids
SECONDS_PER_GROUP = 1.0  # the original gives it to Qwen2.5-VL with its videos
VIDEO_FPS = 1  # the original gives it to Qwen3-VL, which writes each group's time into the prompt
QWEN3 = "qwen3_vl"
VISION_START, VISION_END = "<|vision_start|>", "<|vision_end|>"
IMAGE_PAD, VIDEO_PAD = "<|image_pad|>", "<|video_pad|>"
SMOL_IMAGE, GLOBAL_IMAGE, FAKE = "<image>", "<global-img>", "<fake_token_around_image>"

Spans: TypeAlias = list[tuple[int, int]]


@dataclass(frozen=True, eq=False)
class VlmRow:
    """One conversation.

    input_ids: int64 [L]
    frames: uint8 [T, H, W, 3] of each trajectory
    picked: in dense mode int64 [K], the frames that the conversation shows; None: all
    spans: for each trajectory, the tokens (first, behind the last) over which each frame's state is read
    query: token whose state answers the question about two trajectories
    """

    input_ids: npt.NDArray[np.int64]
    frames: tuple[UInt8Array, ...]
    spans: tuple[Spans, ...]
    query: int | None
    is_similarity: bool
    picked: npt.NDArray[np.int64] | None = None

    @property
    def num_frames(self) -> list[int]:
        """Frames of each trajectory that the conversation shows."""
        return [len(video) for video in self.frames] if self.picked is None else [len(self.picked)]

    def videos(self) -> tuple[UInt8Array, ...]:
        """The frames that the conversation shows, of each trajectory; copied in dense mode, hence late."""
        return self.frames if self.picked is None else (self.frames[0][self.picked],)

    @property
    def num_tokens(self) -> int:
        """L, the number of tokens of the conversation."""
        return len(self.input_ids)


class VlmCollator:
    """What a checkpoint can take of a sample, and how a batch of it looks.

    tokenizer: the base model's, with the checkpoint's special tokens appended and a chat template
    images: preprocessing of the backbone's kind
    """

    def __init__(self, config: VlmConfig, tokenizer: Any, images: QwenImages | SmolImages) -> None:
        self.config = config
        self.tokenizer = tokenizer
        self.images = images
        self._special_tokens = tuple(tokenizer.get_added_vocab())

    def rows(self, sample: Sample) -> list[VlmRow]:
        """The conversations about a sample. Raises InvalidSampleError if the checkpoint cannot score it."""
        if isinstance(sample, SimilaritySample) and not self.config.has_similarity:
            supported = "progress or preference (this checkpoint has no similarity head)"
            raise InvalidSampleError.at("sample_type", supported, "similarity")
        frames = tuple(_frames(trajectory) for trajectory in sample.trajectories)
        self._check_task(sample.trajectories[0].task)
        frame_steps = sample.frame_steps if isinstance(sample, ProgressSample) else 0
        if frame_steps:
            # Every prefix is as long and its frames are as large, so all conversations have the same tokens.
            shown = np.broadcast_to(frames[0][:1], (frame_steps, *frames[0].shape[1:]))
            row = self._row(sample, (shown,))
            return [replace(row, frames=frames, picked=p) for p in prefix_indices(len(frames[0]), frame_steps)]
        return [self._row(sample, frames)]

    def collate(self, rows: Sequence[VlmRow]) -> VlmBatch:
        """A batch of conversations of any kind and length."""
        length = max(row.num_tokens for row in rows)
        pad = self.tokenizer.pad_token_id
        ids = torch.full((len(rows), length), pad, dtype=torch.int64)
        mask = torch.zeros_like(ids)
        shifts = [length - row.num_tokens if self.config.pads_left else 0 for row in rows]
        for index, (row, shift) in enumerate(zip(rows, shifts, strict=True)):
            ids[index, shift : shift + row.num_tokens] = torch.from_numpy(row.input_ids)
            mask[index, shift : shift + row.num_tokens] = 1
        spans = [
            (index, start + shifts[index], stop + shifts[index])
            for index, row in enumerate(rows)
            for of_trajectory in row.spans
            for start, stop in of_trajectory
        ]
        queries = [(index, row.query + shifts[index]) for index, row in enumerate(rows) if row.query is not None]
        query_index = torch.tensor(queries, dtype=torch.int64).reshape(-1, 2)
        inputs = {"input_ids": ids, "attention_mask": mask, **self._pixel_inputs(rows, ids)}
        return VlmBatch(inputs, torch.tensor(spans, dtype=torch.int64), query_index[:, 0], query_index[:, 1])

    def _row(self, sample: Sample, frames: tuple[UInt8Array, ...]) -> VlmRow:
        parts: list[str | dict[str, str]] = []
        for part in question(sample, progress_in_preference=self.config.progress_in_preference):
            parts += self._frame_parts(len(frames[part.index])) if isinstance(part, TrajectoryPart) else [part]
        try:
            text = self._expanded(self._rendered(parts), frames)
        except ValueError as error:  # an image of a shape that cannot be brought to size
            raise InvalidSampleError.at("frames", *str(error).split(", got ")) from error
        ids = np.asarray(self.tokenizer(text, add_special_tokens=False, verbose=False)["input_ids"], np.int64)
        pair = len(frames) > 1
        is_similarity = isinstance(sample, SimilaritySample)
        query_token = SIMILARITY_TOKEN if is_similarity else PREFERENCE_TOKEN
        query = int(self._positions(ids, query_token)[-1]) if pair else None
        return VlmRow(ids, frames, self._spans(ids, frames), query, is_similarity)

    def _frame_parts(self, num_frames: int) -> list[str | dict[str, str]]:
        """Placeholders of one trajectory in the conversation."""
        if not self.config.multi_image:
            return [{"type": "video"}]
        each: list[str | dict[str, str]] = [{"type": "image"}]
        if self.config.per_frame_progress_token:
            each.append(PROGRESS_TOKEN)
        return each * num_frames

    def _rendered(self, parts: Sequence[str | dict[str, str]]) -> str:
        """The chat template's text of one user message."""
        content = [{"type": "text", "text": part} if isinstance(part, str) else part for part in parts]
        conversation = [{"role": "user", "content": content}]
        return str(self.tokenizer.apply_chat_template(conversation, tokenize=False, add_vision_id=True))

    def _expanded(self, text: str, frames: tuple[UInt8Array, ...]) -> str:
        """The text with each placeholder of an image or video as long as its tokens."""
        raise NotImplementedError

    def _spans(self, ids: npt.NDArray[np.int64], frames: tuple[UInt8Array, ...]) -> tuple[Spans, ...]:
        """Where each frame's state is read."""
        raise NotImplementedError

    def _pixel_inputs(self, rows: Sequence[VlmRow], ids: Tensor) -> dict[str, Tensor]:
        """The backbone's arguments about images and videos."""
        raise NotImplementedError

    def _image_spans(
        self, ids: npt.NDArray[np.int64], frames: tuple[UInt8Array, ...], ends: Spans
    ) -> tuple[Spans, ...]:
        """Spans of frames that are images of their own; ``ends``: the tokens around each one's."""
        if self.config.per_frame_progress_token:
            spans = [(int(token), int(token) + 1) for token in self._positions(ids, PROGRESS_TOKEN)]
        elif self.config.frame_pooling == "boundary":
            spans = [(end - 1, end) for _, end in ends]
        else:
            spans = [(start + 1, end) for start, end in ends]
        bounds = np.cumsum([0, *map(len, frames)])
        return tuple(spans[bounds[i] : bounds[i + 1]] for i in range(len(frames)))

    def _positions(self, ids: npt.NDArray[np.int64], token: str) -> npt.NDArray[np.int64]:
        return np.flatnonzero(ids == self.tokenizer.convert_tokens_to_ids(token))

    def _check_task(self, task: str) -> None:
        """A task is data: what would be read as more than text is refused."""
        if not task.strip():
            raise InvalidSampleError.at("task", "a task sentence", repr(task))
        for token in self._special_tokens:
            if token in task:
                raise InvalidSampleError.at("task", "text without the model's special tokens", repr(token))


class QwenCollator(VlmCollator):
    """Qwen2.5-VL and Qwen3-VL: runs of pad tokens between vision start and end, for images or videos."""

    images: QwenImages

    def _expanded(self, text: str, frames: tuple[UInt8Array, ...]) -> str:
        if self.config.multi_image:
            counts = [self.images.image_grid(video).tokens_per_group for video in frames for _ in video]
            return _replaced(text, IMAGE_PAD, [IMAGE_PAD * count for count in counts])
        grids = [self.images.video_grid(video) for video in frames]
        if self.config.family != QWEN3:
            return _replaced(text, VIDEO_PAD, [VIDEO_PAD * (grid.groups * grid.tokens_per_group) for grid in grids])
        return _replaced(text, VISION_START + VIDEO_PAD + VISION_END, [_timed_groups(grid) for grid in grids])

    def _spans(self, ids: npt.NDArray[np.int64], frames: tuple[UInt8Array, ...]) -> tuple[Spans, ...]:
        starts = self._positions(ids, VISION_START)
        if self.config.multi_image:
            ends = list(zip(starts.tolist(), self._positions(ids, VISION_END).tolist(), strict=True))
            return self._image_spans(ids, frames, ends)
        # In strides from the n-th vision start of the row, for the n-th trajectory. Qwen3-VL writes times and a
        # start of its own before each group, which upstream does not heed, in training as in inference.
        grids = [self.images.video_grid(video) for video in frames]
        return tuple(self._video_spans(int(start), grid) for start, grid in zip(starts, grids, strict=False))

    def _video_spans(self, start: int, grid: Grid) -> Spans:
        bounds = [start + group * grid.tokens_per_group for group in range(grid.groups + 1)]
        if self.config.average_temporal_patches:
            return list(pairwise(bounds))
        return [(bound, bound + 1) for bound in bounds[1:]]

    def _pixel_inputs(self, rows: Sequence[VlmRow], ids: Tensor) -> dict[str, Tensor]:
        image_pad, video_pad = (self.tokenizer.convert_tokens_to_ids(pad) for pad in (IMAGE_PAD, VIDEO_PAD))
        types = torch.where(ids == image_pad, IMAGE, torch.where(ids == video_pad, VIDEO, TEXT))
        videos = [video for row in rows for video in row.videos()]
        if self.config.multi_image:
            pixels = [image for video in videos for image in self.images.images(video)]
        else:
            pixels = [self.images.video(video) for video in videos]
        patches = torch.cat([each.patches for each in pixels])
        grids = torch.tensor([astuple(each.grid) for each in pixels])
        inputs = {"mm_token_type_ids": types}  # transformers 5 computes positions from it
        if self.config.multi_image:
            return inputs | {"pixel_values": patches, "image_grid_thw": grids}
        seconds = torch.full((len(pixels),), SECONDS_PER_GROUP)
        return inputs | {"pixel_values_videos": patches, "video_grid_thw": grids, "second_per_grid_ts": seconds}


class SmolCollator(VlmCollator):
    """SmolVLM: images as runs of image tokens between two of FAKE."""

    images: SmolImages

    def _expanded(self, text: str, frames: tuple[UInt8Array, ...]) -> str:
        image = FAKE + GLOBAL_IMAGE + SMOL_IMAGE * self.images.tokens + FAKE
        return text.replace(SMOL_IMAGE, image)

    def _spans(self, ids: npt.NDArray[np.int64], frames: tuple[UInt8Array, ...]) -> tuple[Spans, ...]:
        around = self._positions(ids, FAKE).tolist()
        return self._image_spans(ids, frames, list(zip(around[::2], around[1::2], strict=True)))

    def _pixel_inputs(self, rows: Sequence[VlmRow], ids: Tensor) -> dict[str, Tensor]:
        images = [torch.cat([self.images.images(video) for video in row.videos()]) for row in rows]
        most = max(len(each) for each in images)
        pixels = torch.zeros(len(rows), most, *images[0].shape[1:])  # the backbone leaves out images of zeros
        mask = torch.zeros(len(rows), most, *images[0].shape[2:], dtype=torch.bool)
        for row, each in enumerate(images):
            pixels[row, : len(each)] = each
            mask[row, : len(each)] = True
        return {"pixel_values": pixels, "pixel_attention_mask": mask}


def _frames(trajectory: Trajectory) -> UInt8Array:
    if trajectory.frames is None:
        raise InvalidSampleError.at("video_embeddings", "frames (this checkpoint reads raw frames)", "embeddings")
    return trajectory.frames


def _replaced(text: str, placeholder: str, replacements: Sequence[str]) -> str:
    """The text with each occurrence of ``placeholder`` replaced by the next of ``replacements``."""
    pieces = text.split(placeholder)
    assert len(pieces) == len(replacements) + 1, "the chat template shows each image or video once"
    return pieces[0] + "".join(new + piece for new, piece in zip(replacements, pieces[1:], strict=True))


def _timed_groups(grid: Grid) -> str:
    """A video as Qwen3-VL reads it: each temporal group behind the mean time of its frames."""
    groups = []
    for group in range(grid.groups):
        frame_times = [(group * FRAMES_PER_GROUP + frame) / VIDEO_FPS for frame in range(FRAMES_PER_GROUP)]
        time_s = sum(frame_times) / FRAMES_PER_GROUP
        groups.append(f"<{time_s:.1f} seconds>{VISION_START}{VIDEO_PAD * grid.tokens_per_group}{VISION_END}")
    return "".join(groups)
