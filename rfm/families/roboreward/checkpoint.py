# SPDX-License-Identifier: MIT
"""RoboReward's predictor, for written scores or their expected values, and its checkpoints in memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from rfm.engine.execution import Execution
from rfm.engine.layers import Normalisation, progress_from_logits
from rfm.engine.predictor import RowScores, no_success
from rfm.families.roboreward.prompts import SCORES, RoboRewardCollator, RoboRewardConfig, is_unclear, parsed
from rfm.files import CheckpointError
from rfm.qwen.batch import VlmBatch, VlmRow
from rfm.qwen.images import QwenImages
from rfm.qwen.language import LanguageCheckpoint, LanguageCollator
from rfm.qwen.written import WritingPredictor, WrittenAnswer, unread
from rfm_client.contract import FrameScores, RewardError
from rfm_client.contract.checks import require
from rfm_client.contract.description import Description
from rfm_client.contract.samples import Float32Array


class RoboRewardPredictor(WritingPredictor):
    """A Qwen3-VL on a device, which writes a score."""

    collator: RoboRewardCollator
    expected = f"a score from {SCORES[0]} to {SCORES[-1]} in the model's answer"

    @torch.inference_mode()
    def score(self, rows: Sequence[VlmRow], batch: VlmBatch, execution: Execution) -> list[RowScores | RewardError]:
        """Return each row's scores or error.

        execution: its ``on_forward`` is called after each forward pass
        """
        if not self.collator.config.is_expected:
            return super().score(rows, batch, execution)
        output = self._output(batch)
        logits = output.logits[:, list(self.collator.digits)].float()
        read = zip(progress_from_logits(logits).tolist(), logits.cpu().numpy(), rows, strict=True)
        self._keep_finite(rows, batch, output.made)
        return [_scores(progress, of_digits, row) for progress, of_digits, row in read]

    def read(
        self, text: str, answer: WrittenAnswer, row: VlmRow, execution: Execution
    ) -> RowScores | RewardError | None:
        """Return the scores in an answer, or its error; None: the answer cannot be read."""
        score = parsed(text)
        if score is None:
            return None
        unclear = is_unclear(text, score)
        execution.num_unclear += unclear
        if unclear and self.collator.config.strict_answers:
            return unread(f"one whole score from {SCORES[0]} to {SCORES[-1]} (strict_answers of this model)", text)
        logits = np.full(len(SCORES), np.nan, np.float32) if answer.digit_logits is None else answer.digit_logits
        return _scores((score - SCORES[0]) / (len(SCORES) - 1), logits, row, unclear=unclear)


def _scores(
    progress: float, logits: Float32Array, row: VlmRow, *, unclear: bool | None = None
) -> RowScores | RewardError:
    """Return the same scores for all frames in a row. unclear: None: no answer is written."""
    num_frames = row.videos[0].num_shown
    of_frames = np.full(num_frames, progress, np.float32)
    frames = FrameScores(
        progress=of_frames,
        success=no_success(of_frames),
        progress_logits=np.tile(logits, (num_frames, 1)),
        unclear=None if unclear is None else np.full(num_frames, unclear),
    )
    return RowScores([frames])


@dataclass(frozen=True)
class RoboRewardCheckpoint(LanguageCheckpoint):
    """A RoboReward checkpoint in memory."""

    made_of = RoboRewardConfig
    predictor_of = RoboRewardPredictor
    collator_of = RoboRewardCollator

    @property
    def description(self) -> Description:
        """The model's inputs and outputs."""
        return self.described(
            "RoboReward, expected value of the score" if self.config.is_expected else "RoboReward",
            progress_bins=len(SCORES),
            more_scores=() if self.config.is_expected else ("unclear",),
            scores_whole_prefixes=True,
            may_not_answer=not self.config.is_expected,
            uses_graphs=self.config.is_expected,  # a written answer keeps keys and values, whose number grows
        )

    def load_collator(self) -> LanguageCollator:
        """Return the collator. Raises CheckpointError also for a tokenizer without a token for each score."""
        collator: Any = super().load_collator()
        for score, token in zip(SCORES, collator.digits, strict=True):
            found = collator.tokenizer.decode([token]) == str(score)
            require(f"base model {self.processor}", found, f"a token for {score}", "none", CheckpointError)
        return collator

    def images(self, patch_px: int, normalisation: Normalisation) -> QwenImages:
        """Return the preprocessing of videos, which keeps large frames large."""
        return QwenImages(patch_px, normalisation, max_video_side_px=None)
