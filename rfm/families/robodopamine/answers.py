# SPDX-License-Identifier: MIT
"""Which frames Robo-Dopamine compares, and what its answers mean.

An answer says how far the images AFTER are from those BEFORE, in percent: ``<score>+37%</score>``. Every sampled frame
except the first is AFTER in one question per mode; BEFORE is the previous sampled frame (incremental, benchmark), frame
0 (forward), or the goal (backward). Sources: ``examples/inference.py`` and, for ``benchmark``,
``eval/evaluation_grm.py`` in ``FlagOpen/Robo-Dopamine``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal, TypeAlias

import numpy as np

from rfm.qwen.backbone import Indices

Question: TypeAlias = Literal["incremental", "benchmark", "forward", "backward"]
Mode: TypeAlias = Literal["incremental", "benchmark", "forward", "backward", "mean"]
QUESTIONS: Mapping[Mode, tuple[Question, ...]] = {
    "incremental": ("incremental",),
    "benchmark": ("benchmark",),
    "forward": ("forward",),
    "backward": ("backward",),
    "mean": ("incremental", "forward", "backward"),
}
BEGIN, END = "<score>", "</score>"
MOST_PERCENT = 100


def sampled_frames(num_frames: int, interval: int) -> Indices:
    """Return the frames that are compared, int64: every ``interval``-th, and the last."""
    frames: Indices = np.unique(np.append(np.arange(0, num_frames, interval), num_frames - 1))
    return frames


def parsed(answer: str) -> float | None:
    """Return the score in an answer, -1..1; None: the answer holds no score.

    Parses like the original: the text behind the last ``<score>``, up to the first ``</score>``, without ``%``, as
    Python's ``float``. The original takes an unreadable answer as 0, and ``nan`` as 1.
    """
    text = answer.rpartition(BEGIN)[2].partition(END)[0]
    try:
        percent = float(text.replace("%", "").strip())
    except ValueError:
        return None
    if math.isnan(percent):
        return None
    return max(-MOST_PERCENT, min(MOST_PERCENT, percent)) / MOST_PERCENT


def fused(scores: Sequence[float], question: Question) -> list[float]:
    """Return the progress at each frame AFTER, from the scores in order.

    As in the original, progress is not clipped: a score with the wrong sign leaves 0..1. In ``benchmark`` it stays
    inside, since the first step begins at 0. The first step in ``incremental`` is the score itself.
    """
    if question == "forward":
        return [*scores]
    if question == "backward":
        return [1 + score for score in scores]
    progress = [0.0]
    for score in scores:
        before = progress[-1]
        share = 1 - before if score >= 0 else before
        is_whole = len(progress) == 1 and question == "incremental"
        progress.append(before + (1 if is_whole else share) * score)
    return progress[1:]


def hops(scores: Sequence[float], question: Question) -> list[float]:
    """Return each frame's change: the score if BEFORE was the previous frame, otherwise the change in progress."""
    if question in ("incremental", "benchmark"):
        return [*scores]
    progress = fused(scores, question)
    return [after - before for before, after in zip([0.0, *progress], progress, strict=False)]
