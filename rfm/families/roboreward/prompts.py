# SPDX-License-Identifier: MIT
"""The prompt, frames and answers for RoboReward. Source: ``robometer/evals/baselines/roboreward.py``."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from torch import Tensor

from rfm.qwen.batch import VlmRow
from rfm.qwen.collator import group_times
from rfm.qwen.images import QwenImages
from rfm.qwen.video import VlmVideo
from rfm.qwen.written import WritingCollator, WritingConfig
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
# What follows ANSWER, up to its sentence's end, and the numbers there: 4, but also 1.5, 3/5, -2 and 4-5.
_STATED = re.compile(r"ANSWER:\s*(.*?)(?=[.;!?]\s|[.;!?]?$|ANSWER:)", re.IGNORECASE | re.MULTILINE)
_NUMBER = re.compile(r"[+-]?\d+(?:[.,/:-]\d+)*%?")


@dataclass(frozen=True)
class RoboRewardConfig(WritingConfig):
    """The configuration of RoboReward.

    is_expected: no answer is written; the score is the expected value over the five digits
    strict_answers: an unclear answer is an error; otherwise its score is marked
    """

    is_expected: bool = False
    strict_answers: bool = False

    reward_model: ClassVar[str] = "roboreward"


class RoboRewardCollator(WritingCollator):
    """The collator for RoboReward: one conversation about all frames, or one per prefix in dense mode."""

    config: RoboRewardConfig

    def __init__(self, config: RoboRewardConfig, tokenizer: Any, images: QwenImages) -> None:
        super().__init__(config, tokenizer, images, "" if config.is_expected else BEFORE_ANSWER)
        self.digits = [int(tokenizer.convert_tokens_to_ids(str(score))) for score in SCORES]

    def example(self) -> str:
        """Return the prompt for an example task, with VIDEO as placeholder."""
        return self.template(PROMPT, add_generation_prompt=True) + BEFORE_ANSWER * self.config.is_expected

    def prompts(self, video: VlmVideo, task: str) -> list[VlmRow]:
        """Return the conversations about a video. Raises InvalidSampleError for frames that cannot be resized."""
        text = self.template(PROMPT.replace("{task}", task), add_generation_prompt=True)
        more = self._chat.tokens(BEFORE_ANSWER) if self.config.is_expected else ()
        times_s = group_times(self.grid(video).groups)
        return [self.row(video, text, shown, times_s, more) for shown in video.conversations]

    def _to_size(self, video: VlmVideo, needed: Sequence[int]) -> Tensor:
        frames = [as_jpeg(video.frames[index]) for index in needed]
        height, width = video.size
        stacked = np.stack(frames) if frames else np.empty((0, height, width, 3), np.uint8)
        return self.images.video_to_size(stacked, video.num_shown)


def as_jpeg(frame: UInt8Array) -> UInt8Array:
    """Return a frame, uint8 [H, W, 3], after a round trip through JPEG.

    The original also optimises the Huffman tables, which takes half the time and changes no pixel.
    """
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(frame).save(file, format="JPEG", quality=JPEG_QUALITY)
    with Image.open(file) as image:
        return np.array(image)


def parsed(answer: str) -> int | None:
    """Return the score in an answer: the number behind ANSWER, otherwise the last lone digit; None: there is none."""
    found = _ANSWER.search(answer)
    if found is not None and int(found[1]) in SCORES:
        return int(found[1])
    alone = _ALONE.findall(answer)
    return int(alone[-1]) if alone else None


def is_unclear(answer: str, score: int) -> bool:
    """True unless the only number that an answer states, behind ANSWER or anywhere, is the score ``parsed`` found."""
    stated = _STATED.findall(answer) or [answer]
    return any(_NUMBER.findall(text) != [str(score)] for text in stated)
