# SPDX-License-Identifier: MIT
"""The conversations for RFM and Robometer, with the same tokens as in upstream's inference collator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from rfm.engine.predictor import check_type
from rfm.families.robometer.prompts import PREFERENCE_TOKEN, PROGRESS_TOKEN, SIMILARITY_TOKEN, TrajectoryPart, question
from rfm.qwen.batch import Spans, VlmRow
from rfm.qwen.collator import (
    IMAGE_PAD,
    VIDEO_PAD,
    VISION_END,
    VISION_START,
    QwenCollator,
    Visual,
    expanded,
    group_times,
    timed_groups,
    video_of,
)
from rfm.qwen.images import Grid
from rfm.qwen.network import QWEN3
from rfm.qwen.video import Indices, VlmVideo
from rfm_client.contract import ProgressSample, Sample, SimilaritySample


class VlmCollator(QwenCollator):
    """The collator for RFM and Robometer, with the same tokens as upstream's inference collator."""

    def rows(self, sample: Sample) -> list[VlmRow]:
        """Return a sample's conversations. Raises InvalidSampleError if the checkpoint cannot score the sample."""
        check_type(sample, self.config)
        frame_steps = sample.frame_steps if isinstance(sample, ProgressSample) else 0
        videos = tuple(video_of(trajectory, frame_steps) for trajectory in sample.trajectories)
        self._check_task(sample.trajectories[0].task)
        row = self._row(sample, videos)
        if frame_steps:
            # All prefixes show equally many frames with the same size, so all conversations have the same tokens.
            return [replace(row, picked=picked) for picked in videos[0].conversations]
        return [row]

    def _row(self, sample: Sample, videos: tuple[VlmVideo, ...]) -> VlmRow:
        parts: list[str | Visual] = []
        for part in question(sample, progress_in_preference=self.config.progress_in_preference):
            parts += self._frame_parts(videos[part.index].num_shown) if isinstance(part, TrajectoryPart) else [part]
        text, pad, lengths = self._placed(self._chat.text(tuple(parts)), videos)
        ids = expanded(self._chat.tokens(text), self.tokenizer.convert_tokens_to_ids(pad), lengths)
        is_similarity = isinstance(sample, SimilaritySample)
        query_token = SIMILARITY_TOKEN if is_similarity else PREFERENCE_TOKEN
        query = int(self._positions(ids, query_token)[-1]) if len(videos) > 1 else None
        return VlmRow(
            ids, videos, self._spans(ids, videos), query, is_similarity, position_ids=self._position_ids(ids, videos)
        )

    def _frame_parts(self, num_frames: int) -> list[str | Visual]:
        if not self.config.multi_image:
            return [Visual.VIDEO]
        each: list[str | Visual] = [Visual.IMAGE]
        if self.config.per_frame_progress_token:
            each.append(PROGRESS_TOKEN)
        return each * num_frames

    def _image_spans(self, ids: Indices, videos: tuple[VlmVideo, ...], ends: Spans) -> tuple[Spans, ...]:
        """Return the token spans for frames that are separate images; ``ends``: the tokens around each image."""
        if self.config.per_frame_progress_token:
            spans = [(int(token), int(token) + 1) for token in self._positions(ids, PROGRESS_TOKEN)]
        elif self.config.frame_pooling == "boundary":
            spans = [(end - 1, end) for _, end in ends]
        else:
            spans = [(start + 1, end) for start, end in ends]
        bounds = np.cumsum([0, *(video.num_shown for video in videos)])
        return tuple(spans[bounds[i] : bounds[i + 1]] for i in range(len(videos)))

    def _placed(self, text: str, videos: tuple[VlmVideo, ...]) -> tuple[str, str, list[int]]:
        """Return the text with a pad token for each image, video or temporal patch, this token, and its repetitions."""
        grids = [self.grid(video) for video in videos]
        of_shots = [grid.tokens_per_group for grid in grids for _ in range(grid.groups)]
        if self.config.multi_image:
            return text, IMAGE_PAD, of_shots
        if self.config.family != QWEN3:
            return text, VIDEO_PAD, [grid.groups * grid.tokens_per_group for grid in grids]
        timed = ["".join(self._around(timed_groups(group_times(grid.groups)))) for grid in grids]
        return _replaced(text, VISION_START + VIDEO_PAD + VISION_END, timed), VIDEO_PAD, of_shots

    def _spans(self, ids: Indices, videos: tuple[VlmVideo, ...]) -> tuple[Spans, ...]:
        """Return the tokens at which each frame's state is read."""
        starts = self._positions(ids, VISION_START)
        if self.config.multi_image:
            ends = list(zip(starts.tolist(), self._positions(ids, VISION_END).tolist(), strict=True))
            return self._image_spans(ids, videos, ends)
        # As upstream: strides from the row's n-th vision start for the n-th trajectory. Upstream ignores, in training
        # and inference, that Qwen3-VL writes a time and a vision start before each temporal patch.
        grids = map(self.grid, videos)
        return tuple(self._video_spans(int(start), grid) for start, grid in zip(starts, grids, strict=False))

    def _video_spans(self, start: int, grid: Grid) -> Spans:
        bounds = [start + group * grid.tokens_per_group for group in range(grid.groups + 1)]
        if self.config.average_temporal_patches:
            return list(pairwise(bounds))
        return [(bound, bound + 1) for bound in bounds[1:]]


def _replaced(text: str, placeholder: str, replacements: Sequence[str]) -> str:
    pieces = text.split(placeholder)
    assert len(pieces) == len(replacements) + 1, "the chat template shows each image or video once"
    return pieces[0] + "".join(new + piece for new, piece in zip(replacements, pieces[1:], strict=True))
