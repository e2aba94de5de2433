# SPDX-License-Identifier: MIT
"""The conversations for RFM and Robometer, with the same words and tokens as in upstream's inference collator.

A question is a list of parts in reading order: text and whole trajectories. The chat template turns it into text, the
tokenizer the text into tokens. Scores depend on the wording.
Source: the collators in ``reward_fm`` and ``robometer``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from rfm.engine.predictor import check_type
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
from rfm_client.contract import PreferenceSample, ProgressSample, Sample, SimilaritySample

SPLIT_TOKEN = "<|split_token|>"
REWARD_TOKEN = "<|reward_token|>"
PREFERENCE_TOKEN = "<|pref_token|>"
SIMILARITY_TOKEN = "<|sim_token|>"
PROGRESS_TOKEN = "<|prog_token|>"
# In the order in which the tokenizer gets them.
SPECIAL_TOKENS = (SPLIT_TOKEN, REWARD_TOKEN, PREFERENCE_TOKEN, SIMILARITY_TOKEN, PROGRESS_TOKEN)
OLD_RUN_REMEDY = (
    "a run from before 2026-01-21 had 8 special tokens, resized images and no frame_pool_attn: score it with the "
    "upstream commit that trained it, or train it anew"
)
_PROGRESS_SCALE = (
    "how far along the robot is towards completing the task, a float between 0 and 1, where 0 is the starting state "
    "and 1 is when the task is completed. If the robot is not performing the same task, predict 0 progress."
)
PROGRESS_PROMPT = (
    "The task for the robot is '{task}'. Given the trajectory video, predict the task progress at each frame, "
    + _PROGRESS_SCALE
)
PREFERENCE_PROMPT = (
    "Given these two trajectories for the task '{task}', evaluate which one makes more progress towards the task. "
    "Return A for the first trajectory and B for the second trajectory."
)
PREFERENCE_PROGRESS_PROMPT = " Also predict the task progress at each frame of the first trajectory, " + _PROGRESS_SCALE
SIMILARITY_PROMPT = (
    "For the task '{task}', compare these two trajectories and evaluate how similar they are in terms of "
    "task completion and behavior."
)


@dataclass(frozen=True)
class TrajectoryPart:
    """The place in a question where the frames of trajectory ``index`` (0 or 1) appear."""

    index: int


Part: TypeAlias = str | TrajectoryPart


def question(sample: Sample, *, progress_in_preference: bool) -> list[Part]:
    """Return the prompt parts for a sample.

    progress_in_preference: the checkpoint was trained with preference prompts that also ask for progress
    """
    task = sample.trajectories[0].task
    if isinstance(sample, ProgressSample):
        return [PROGRESS_PROMPT.replace("{task}", task), TrajectoryPart(0)]
    if isinstance(sample, PreferenceSample):
        also = PREFERENCE_PROGRESS_PROMPT if progress_in_preference else ""
        return [
            PREFERENCE_PROMPT.replace("{task}", task) + also,
            "This is Trajectory A. ",
            TrajectoryPart(0),
            SPLIT_TOKEN,
            "This is Trajectory B. ",
            TrajectoryPart(1),
            "Now predict the preference between the two trajectories.",
            PREFERENCE_TOKEN,
        ]
    return [
        SIMILARITY_PROMPT.replace("{task}", task),
        "This is the first trajectory. ",
        TrajectoryPart(0),
        SPLIT_TOKEN,
        "This is the second trajectory. ",
        TrajectoryPart(1),
        SIMILARITY_TOKEN,
    ]


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
