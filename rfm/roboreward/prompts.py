# SPDX-License-Identifier: MIT
"""The prompt, the frames and the answers of RoboReward. Source: ``robometer/evals/baselines/roboreward.py``."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from rfm.vlm.batch import VlmBatch
from rfm.vlm.collator import group_times
from rfm.vlm.images import QwenImages
from rfm.vlm.language import LanguageCollator, LanguageConfig
from rfm.vlm.row import VlmRow
from rfm.vlm.video import VlmVideo
from rfm_client.contract.samples import UInt8Array

PROMPT = """Given the task, assign a discrete progress score reward (1,2,3,4,5) for the robot in the video in the format: ANSWER: <score>
Rubric for end-of-episode progress (judge only the final state without time limits):
1 - No Success: Final state shows no goal-relevant change for the command.
2 - Minimal Progress: Final state shows a small but insufficient change toward the goal.
3 - Partial Completion: The final state shows good progress toward the goal but violates more than one requirement or a major requirement.
4 - Near Completion: Final state is correct in region and intent but misses a single minor requirement.
5 - Perfect Completion: Final state satisfies all requirements.

Task: {task}"""  # noqa: E501
BEFORE_ANSWER = "ANSWER: "
SCORES = (1, 2, 3, 4, 5)
JPEG_QUALITY = 85
_ANSWER = re.compile(r"ANSWER:\s*(\d+)", re.IGNORECASE)
_ALONE = re.compile(r"\b([1-5])\b")
# What follows each ANSWER, up to the end of its sentence, and the numbers in it: 4, but also 1.5, 3/5, -2 and 4-5.
_STATED = re.compile(r"ANSWER:\s*(.*?)(?=[.;!?]\s|[.;!?]?$|ANSWER:)", re.IGNORECASE | re.MULTILINE)
_NUMBER = re.compile(r"[+-]?\d+(?:[.,/:-]\d+)*%?")


@dataclass(frozen=True)
class RoboRewardConfig(LanguageConfig):
    """The configuration of RoboReward.

    stops: ids of the tokens that end an answer
    max_new_tokens: most tokens of an answer
    is_expected: the answer is not written: its expected value over the five digits is the score
    strict_answers: an unclear answer is an error; else its score is marked
    """

    stops: tuple[int, ...]
    max_new_tokens: int = 128
    is_expected: bool = False
    strict_answers: bool = False

    reward_model: ClassVar[str] = "roboreward"


class RoboRewardCollator(LanguageCollator):
    """The collator of RoboReward: one conversation about all frames, in dense mode one for each prefix.

    draft: int64 [N], the tokens with which a written answer usually begins
    """

    config: RoboRewardConfig  # type: ignore[assignment]  # no heads, so no VlmConfig

    def __init__(self, config: RoboRewardConfig, tokenizer: Any, images: QwenImages) -> None:
        super().__init__(config, tokenizer, images)
        self._before_answer = self._chat.tokens(BEFORE_ANSWER)
        self.draft = self._before_answer[:0] if config.is_expected else self._before_answer

    @cached_property
    def digits(self) -> list[int]:
        """The tokens of SCORES."""
        return [int(self.tokenizer.convert_tokens_to_ids(str(score))) for score in SCORES]

    def example(self) -> str:
        """Return the prompt of an example task, with VIDEO in the place of the video."""
        return self.template(PROMPT, add_generation_prompt=True) + BEFORE_ANSWER * self.config.is_expected

    def prompts(self, video: VlmVideo, task: str) -> list[VlmRow]:
        """Return the conversations about a video. Raises ValueError for frames that cannot be resized."""
        text = self.template(PROMPT.replace("{task}", task), add_generation_prompt=True)
        more = self._before_answer if self.config.is_expected else ()
        times_s = group_times(self.grid(video).groups)
        return [self.row(video, text, shown, times_s, more) for shown in video.conversations]

    def collate(self, rows: Sequence[VlmRow], length: int | None = None) -> VlmBatch:
        """Return the batch of conversations with the draft behind each.

        length: as in ``VlmCollator.collate``
        The queries are the last token of each conversation and the tokens of the draft.
        """
        batch = super().collate([self._drafted(row) for row in rows], length)
        back = torch.arange(-len(self.draft), 1)
        return replace(
            batch,
            query_rows=batch.query_rows.repeat_interleave(len(back)),
            query_tokens=(batch.query_tokens[:, None] + back).flatten(),
        )

    def _drafted(self, row: VlmRow) -> VlmRow:
        at = row.position_ids[:, -1:] + 1 + np.arange(len(self.draft))
        return replace(
            row,
            input_ids=np.concatenate([row.input_ids, self.draft]),
            position_ids=np.concatenate([row.position_ids, at], axis=1),
            query=row.num_tokens + len(self.draft) - 1,
        )

    def _to_size(self, video: VlmVideo, needed: Sequence[int]) -> Tensor:
        frames = [as_jpeg(video.frames[index]) for index in needed]
        height, width = video.size
        stacked = np.stack(frames) if frames else np.empty((0, height, width, 3), np.uint8)
        return self.images.video_to_size(stacked, video.num_shown)


def as_jpeg(frame: UInt8Array) -> UInt8Array:
    """Return a frame, uint8 [H, W, 3], after a round trip through JPEG.

    The original also optimises the Huffman tables, which takes half of the time and changes no pixel.
    """
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(frame).save(file, format="JPEG", quality=JPEG_QUALITY)
    with Image.open(file) as image:
        return np.array(image)


def parsed(answer: str) -> int | None:
    """Return the score in an answer: the number behind ANSWER, else the last digit alone; None: there is none."""
    found = _ANSWER.search(answer)
    if found is not None and int(found[1]) in SCORES:
        return int(found[1])
    alone = _ALONE.findall(answer)
    return int(alone[-1]) if alone else None


def is_unclear(answer: str, score: int) -> bool:
    """True unless an answer states one number, the score that ``parsed`` found, behind ANSWER or at all."""
    stated = _STATED.findall(answer) or [answer]
    return any(_NUMBER.findall(text) != [str(score)] for text in stated)
