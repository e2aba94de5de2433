# SPDX-License-Identifier: MIT
"""The exact prompts of vision-language checkpoints: scores depend on the wording.

A question is a list of parts in reading order: text and whole trajectories. The chat template turns it into text, the
tokenizer the text into tokens.
Source: the collators of ``reward_fm`` and ``robometer``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np

from rfm.vlm.video import Indices
from rfm_client.contract import PreferenceSample, ProgressSample, Sample

SPLIT_TOKEN = "<|split_token|>"
REWARD_TOKEN = "<|reward_token|>"
PREFERENCE_TOKEN = "<|pref_token|>"
SIMILARITY_TOKEN = "<|sim_token|>"
PROGRESS_TOKEN = "<|prog_token|>"
# In the order in which the tokenizer gets them.
SPECIAL_TOKENS = (SPLIT_TOKEN, REWARD_TOKEN, PREFERENCE_TOKEN, SIMILARITY_TOKEN, PROGRESS_TOKEN)
OLD_SPECIAL_TOKENS = 8  # number of upstream's special tokens before 2026-01-21
OF_AN_OLD_RUN = (
    "upstream's networks have it since 2026-01-21. A run of before that day was trained with 8 special tokens in place "
    "of 5, and with resized images; score it with the upstream commit that trained it, or train it anew"
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
    """The place of the frames of trajectory ``index`` (0 or 1) in a question."""

    index: int


Part: TypeAlias = str | TrajectoryPart


def question(sample: Sample, *, progress_in_preference: bool) -> list[Part]:
    """Return the parts of the prompt for a sample.

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


KEPT_TEXTS = 256  # cached conversations; an RL loop repeats the same task
MAX_KEPT_BYTES = 16_384  # of a conversation's text; a task and 128 frames have fewer. A byte is at most one token
FRAME_BYTES = 64  # of a chat template's text for a frame, about


class Visual(Enum):
    """The parts of a chat template besides text, by their names in it."""

    IMAGE = "image"
    VIDEO = "video"


class Chat:
    """A base model's chat template and tokenizer, with a cache of the latest short conversations."""

    def __init__(self, tokenizer: Any) -> None:
        self._tokenizer = tokenizer
        self._text = lru_cache(KEPT_TEXTS)(self._render)
        self._tokens = lru_cache(KEPT_TEXTS)(self._tokenise)

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
