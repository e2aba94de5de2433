# SPDX-License-Identifier: MIT
"""Robo-Dopamine's predictor, which computes progress from the written scores of frame pairs, and its checkpoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rfm.engine.execution import Execution
from rfm.engine.predictor import RowScores, no_success
from rfm.families.robodopamine.prompts import (
    QUESTIONS,
    RoboDopamineCollator,
    RoboDopamineConfig,
    fused,
    hops,
    parsed,
    sampled_frames,
)
from rfm.qwen.batch import VlmRow
from rfm.qwen.language import LanguageCheckpoint
from rfm.qwen.written import WritingPredictor, WrittenAnswer, progress_of
from rfm_client.contract import FrameScores, Sample
from rfm_client.contract.description import Description


class RoboDopaminePredictor(WritingPredictor):
    """A Qwen-VL on a device, which writes how far one set of images is from another."""

    collator: RoboDopamineCollator
    reads_views = True
    expected = "a score in percent, as <score>+37%</score>, in the model's answer"

    def read(self, text: str, answer: WrittenAnswer, row: VlmRow, execution: Execution) -> RowScores | None:
        """Return the score in an answer as if it were progress; None: the answer cannot be read."""
        score = parsed(text)
        return None if score is None else progress_of(score)

    def joined(self, sample: Sample, rows: Sequence[RowScores]) -> FrameScores:
        """Return progress and its changes at the sampled frames except the first; NaN: no answer for the frame."""
        config, num_frames = self.collator.config, sample.trajectories[0].num_frames
        questions = QUESTIONS[config.mode]
        scores = np.array([row.frames[0].progress[0] for row in rows], np.float64).reshape(len(questions), -1).tolist()
        made = {
            "progress": [fused(*each) for each in zip(scores, questions, strict=True)],
            "hop": [hops(*each) for each in zip(scores, questions, strict=True)],
        }
        after = sampled_frames(num_frames, config.interval)[1:]
        arrays = {name: np.full(num_frames, np.nan, np.float32) for name in made}
        for name, of_questions in made.items():
            arrays[name][after] = np.mean(of_questions, axis=0)
        progress = arrays["progress"]
        return FrameScores(progress=progress, success=no_success(progress), hop=arrays["hop"])


@dataclass(frozen=True)
class RoboDopamineCheckpoint(LanguageCheckpoint):
    """A Robo-Dopamine GRM in memory."""

    made_of = RoboDopamineConfig
    predictor_of = RoboDopaminePredictor
    collator_of = RoboDopamineCollator
    reads_videos: ClassVar[bool] = False

    @property
    def description(self) -> Description:
        """The model's inputs and outputs."""
        return self.described(
            f"Robo-Dopamine, {self.config.mode}",
            more_scores=("hop",),
            needs_whole_episode=True,
            reads_views=True,
            may_not_answer=True,
        )
