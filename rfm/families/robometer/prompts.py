# SPDX-License-Identifier: MIT
"""The exact prompts for vision-language checkpoints: scores depend on the wording.

A question is a list of parts in reading order: text and whole trajectories. The chat template turns it into text, the
tokenizer the text into tokens.
Source: the collators in ``reward_fm`` and ``robometer``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from rfm_client.contract import PreferenceSample, ProgressSample, Sample

SPLIT_TOKEN = "<|split_token|>"
REWARD_TOKEN = "<|reward_token|>"
PREFERENCE_TOKEN = "<|pref_token|>"
SIMILARITY_TOKEN = "<|sim_token|>"
PROGRESS_TOKEN = "<|prog_token|>"
# In the order in which the tokenizer gets them.
SPECIAL_TOKENS = (SPLIT_TOKEN, REWARD_TOKEN, PREFERENCE_TOKEN, SIMILARITY_TOKEN, PROGRESS_TOKEN)
OLD_SPECIAL_TOKENS = 8  # upstream's special token count before 2026-01-21
OLD_RUN_REMEDY = (
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
