# SPDX-License-Identifier: MIT
"""The RoboReward predictor: reads the scores in written answers, or computes their expected values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from rfm.engine.execution import Execution
from rfm.engine.layers import progress_from_logits
from rfm.engine.predictor import RowScores, no_success
from rfm.families.roboreward.prompts import SCORES, RoboRewardCollator, is_unclear, parsed
from rfm.qwen.batch import VlmBatch, VlmRow
from rfm.qwen.written import WritingPredictor, WrittenAnswer, unread
from rfm_client.contract import FrameScores, RewardError
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
