# SPDX-License-Identifier: MIT
"""The prompt, frames and rows for RynnValue: one conversation, in which value tokens follow each frame.

L tokens. Source: ``rynn_value`` in ``alibaba-damo-academy/RynnValue``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from rfm.engine.predictor import check_type
from rfm.families.rynnvalue.network import RynnBatch, RynnConfig
from rfm.files import CheckpointError
from rfm.qwen.batch import VlmRow
from rfm.qwen.collator import IMAGE_PAD, KEPT_TEXTS, VISION_END, VISION_START, QwenCollator, video_of
from rfm.qwen.images import BoundedImages
from rfm.qwen.leaves import Leaf, fits
from rfm.qwen.tree import trees
from rfm.qwen.video import Indices, VlmVideo
from rfm_client.contract import ProgressSample, Sample

VALUE_TOKEN, RELATIVE_TOKEN = "<value>", "<relative_value>"
IMAGE = VISION_START + IMAGE_PAD + VISION_END
END_OF_TURN = "<|im_end|>"
META = {"robot_description": "The agent is {}.", "camera_description": "The observation is captured from {}."}
BEFORE_FRAMES = (
    "The agent is performing the following task: {task}."
    "Question: For each frame after the first, what is the time delta from the previous frame?"
    "Question: Estimate the minimum remaining time in seconds until the agent completes the task."
)
BEHIND_FRAMES = (
    "Analyze this trajectory. Provide:\n"
    "- Video Description: a brief description of what the agent is doing in the video.\n"
    "- Match: whether the video matches the stated task (Yes/No).\n"
    "- Success: whether the agent has completed the task (Yes/No)."
    "Analysis: \n"
)


@dataclass(frozen=True, eq=False)
class Conversation:
    """The tokens in a conversation about several frames.

    input_ids, position_ids: int64 [L] and [3, L]
    groups: by frame, its groups of value tokens (first, behind the last): the relative one, from the second frame on,
        and the value
    """

    input_ids: Indices
    position_ids: Indices
    groups: list[list[tuple[int, int]]]

    @property
    def slots(self) -> Indices:
        """Each token's group number, int64 [L]; -1: an ordinary token."""
        slots = np.full(len(self.input_ids), -1)
        for number, (first, behind) in enumerate(group for of_frame in self.groups for group in of_frame):
            slots[first:behind] = number
        return slots


class RynnCollator(QwenCollator):
    """The collator for RynnValue: one conversation about all frames, or one per prefix in dense mode.

    A row ends with the last value token: nothing behind it changes a value. With isolated attention, the row has no
    value tokens at all: no other token sees them, so the groups follow the conversation as leaves.
    """

    config: RynnConfig  # not a VlmConfig, whose heads differ
    images: BoundedImages

    def __init__(self, config: RynnConfig, tokenizer: Any, images: BoundedImages) -> None:
        super().__init__(config, tokenizer, images)  # not a VlmConfig
        self._around_frames = lru_cache(KEPT_TEXTS)(self._rendered)

    def check_template(self) -> None:
        """Raise CheckpointError unless a prompt has its frame once, in a turn that ends."""
        for name in META:
            words = getattr(self.config, name) or ""
            if unfit := [token for token in self._special_tokens if token in words]:
                raise CheckpointError.at(name, "text without the model's special tokens", repr(unfit[0]))
        text = self._template("TASK")
        if text.count(IMAGE) != 1 or END_OF_TURN not in text.partition(IMAGE)[2]:
            raise CheckpointError.at("chat template", f"one {IMAGE} and then {END_OF_TURN}", repr(text))

    def example(self) -> str:
        """Return the prompt for an example task with two frames."""
        before, behind = self._around_frames("TASK")
        relative, value = RELATIVE_TOKEN * self.config.relative_copies, VALUE_TOKEN * self.config.value_copies
        return before + IMAGE + value + IMAGE + relative + value + behind

    def rows(self, sample: Sample) -> list[VlmRow]:
        """Return the conversations for a progress sample. Raises InvalidSampleError."""
        check_type(sample, self.config)
        assert isinstance(sample, ProgressSample)  # by check_type
        (trajectory,) = sample.trajectories
        self._check_task(trajectory.task)
        video = video_of(trajectory, sample.frame_steps)
        conversation = self.conversation(video, trajectory.task)
        read = conversation.groups[-1:] if sample.frame_steps else conversation.groups
        of_prefixes = video.conversations if sample.frame_steps else [None]
        if self.config.attention == "causal":
            return [_causal(conversation, video, read, picked) for picked in of_prefixes]
        bare, groups = _without_groups(conversation, read, video.conversations[0][:1])
        rows = [_bare(bare, video, picked) for picked in of_prefixes]
        return [_with_groups(row, groups) for row in trees(rows, self.visual_pad, are_images=True)]

    def conversation(self, video: VlmVideo, task: str) -> Conversation:
        """Return the whole conversation about ``video.num_shown`` frames."""
        before, behind = (self._chat.tokens(text) for text in self._around_frames(task))
        start, pad, end = map(self.tokenizer.convert_tokens_to_ids, (VISION_START, IMAGE_PAD, VISION_END))
        frame = np.array([start, *[pad] * self.grid(video).tokens_per_group, end])
        relative = np.full(self.config.relative_copies, self.config.relative_token)
        value = np.full(self.config.value_copies, self.config.value_token)
        parts, groups, first = [before], list[list[tuple[int, int]]](), len(before)
        for index in range(video.num_shown):
            first += len(frame)
            parts.append(frame)
            groups.append([])
            for group in [relative, value] if index else [value]:
                parts.append(group)
                groups[-1].append((first, first + len(group)))
                first += len(group)
        ids = np.concatenate([*parts, behind]).astype(np.int64)
        return Conversation(ids, self._position_ids(ids, (video,)), groups)

    def collate(self, rows: Sequence[VlmRow], length: int | None = None) -> RynnBatch:
        """Return the conversations as a batch. length: as in ``QwenCollator.collate``."""
        return RynnBatch.of(super().collate(rows, length), self.config.relative_token, self.config.relative_copies)

    def num_groups(self, row: VlmRow) -> tuple[int, int]:
        """Return how many values and how many relative values are read from a row."""
        parts = [leaf.input_ids[slice(*leaf.reads)] for leaf in row.leaves]
        ids = np.concatenate([*parts, *(row.input_ids[slice(*span)] for span in row.spans[0])])
        values, relatives = ((ids == token).sum() for token in (self.config.value_token, self.config.relative_token))
        return int(values) // self.config.value_copies, int(relatives) // self.config.relative_copies

    def _rendered(self, task: str) -> tuple[str, str]:
        """Return the text before the first frame, and the text behind the last frame's value tokens."""
        before, _, behind = self._template(task).partition(IMAGE)
        return before, behind.rpartition(END_OF_TURN)[0]

    def _template(self, task: str) -> str:
        words = {name: getattr(self.config, name) for name in META}
        meta = " ".join(META[name].format(text) for name, text in words.items() if text is not None)
        before = meta + BEFORE_FRAMES.replace("{task}", task)
        content = [{"type": "text", "text": before}, {"type": "image"}, {"type": "text", "text": BEHIND_FRAMES}]
        return str(self.tokenizer.apply_chat_template([{"role": "user", "content": content}], tokenize=False))


def _causal(
    conversation: Conversation, video: VlmVideo, read: list[list[tuple[int, int]]], picked: Indices | None
) -> VlmRow:
    """Return a conversation as a row, with ordinary tokens for the values."""
    spans = [(of_frame[0][0], of_frame[-1][1]) for of_frame in read]
    end = spans[-1][1]
    ids, at = conversation.input_ids[:end], conversation.position_ids[:, :end]
    return VlmRow(ids, (video,), (spans,), None, False, picked=picked, position_ids=at)


def _without_groups(
    conversation: Conversation, read: list[list[tuple[int, int]]], a_frame: Indices
) -> tuple[Conversation, list[Leaf]]:
    """Return the conversation up to the last frame, without value tokens, and the groups that are read, as leaves.

    a_frame: any frame in the video, for leaves that show none
    """
    is_kept = (conversation.slots < 0) & (np.arange(len(conversation.slots)) < read[-1][-1][1])
    ids, at = conversation.input_ids, conversation.position_ids
    leaves = [
        Leaf(
            int(is_kept[:first].sum()), (), ids[first:behind], at[:, first:behind], a_frame, (0, behind - first),
            is_mutual=True,
        )
        for of_frame in read
        for first, behind in of_frame
    ]  # fmt: skip
    return Conversation(ids[is_kept], at[:, is_kept], []), leaves


def _bare(conversation: Conversation, video: VlmVideo, picked: Indices | None) -> VlmRow:
    """Return a conversation as a row from which nothing is read."""
    end = len(conversation.input_ids)
    ids, at = conversation.input_ids, conversation.position_ids
    return VlmRow(ids, (video,), ([(end, end)],), None, False, picked=picked, position_ids=at)


def _with_groups(row: VlmRow, groups: Sequence[Leaf]) -> VlmRow:
    """Return the row, or tree of rows, with the groups behind each conversation."""
    packs: list[tuple[Leaf, ...]] = []
    for pack in row.packs:
        behind = [
            replace(group, from_trunk=leaf.from_trunk, from_leaves=(*leaf.from_leaves, (index, leaf.num_tokens)))
            for index, leaf in enumerate(pack)
            for group in groups
        ]
        packs.append((*pack, *behind))
    for group in map(replace, groups):  # gives every leaf its own object
        num_tokens = group.num_tokens + sum(leaf.num_tokens for leaf in packs[-1]) if packs else 0
        if packs and fits(num_tokens, row.num_tokens):
            packs[-1] = (*packs[-1], group)
        else:
            packs.append((group,))
    return replace(row, packs=tuple(packs), alone=tuple(_with_groups(each, groups) for each in row.alone))
