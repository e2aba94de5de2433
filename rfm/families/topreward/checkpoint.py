# SPDX-License-Identifier: MIT
"""TOPReward's predictor, and its checkpoints: no separate weights, only a prompt and its settings.

The predictor takes the answer's log-probability behind each prefix, and progress relative to these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from rfm.engine.execution import Execution
from rfm.engine.layers import Normalisation
from rfm.engine.predictor import RowScores, no_success
from rfm.families.topreward.prompts import TopRewardCollator, TopRewardConfig, TopRewardImages
from rfm.qwen.batch import VlmBatch, VlmRow
from rfm.qwen.images import FRAMES_PER_GROUP, QwenImages
from rfm.qwen.language import LanguageCheckpoint
from rfm.qwen.predictor import QwenPredictor
from rfm_client.contract import FrameScores, RewardError, Sample
from rfm_client.contract.description import Description
from rfm_client.contract.samples import Float32Array


class TopRewardPredictor(QwenPredictor):
    """A Qwen3-VL on a device, which is asked whether a video completes the task."""

    collator: TopRewardCollator

    @torch.inference_mode()
    def score(self, rows: Sequence[VlmRow], batch: VlmBatch, execution: Execution) -> list[RowScores | RewardError]:
        """Run one forward pass; return the answer's log-probability for every prefix in a row, or the row's error."""
        output = self._output(batch)
        prefixes = [ids for row in rows for ids in (*(leaf.input_ids for leaf in row.leaves), row.input_ids)]
        answers = torch.tensor([int(ids[-1]) for ids in prefixes]).to(output.logits.device)
        logits = output.logits.float() if self.collator.config.variant == "lerobot" else output.logits
        log_probs = logits.log_softmax(-1).gather(1, answers[:, None])[:, 0].float().cpu().numpy()
        if np.isfinite(log_probs).all():
            self._keep(rows, batch.layout, output.made)
        ends = np.cumsum([len(row.leaves) + 1 for row in rows])
        return [RowScores([_unjoined(of_row)]) for of_row in np.split(log_probs, ends[:-1])]

    def joined(self, sample: Sample, rows: Sequence[RowScores]) -> FrameScores:
        """Return an episode's frame scores: progress is 0 at the least likely prefix, 1 at the likeliest."""
        num_frames = sample.trajectories[0].num_frames
        prefixes = self.collator.config.prefixes(num_frames)
        log_probs = FrameScores.joined([row.frames[0] for row in rows]).log_prob
        assert log_probs is not None  # by ``score``
        progress = self._progress(log_probs, num_frames)
        frames = np.arange(1, num_frames + 1)
        progress, log_prob = (
            np.interp(frames, prefixes, values).astype(np.float32) for values in (progress, log_probs)
        )
        return FrameScores(progress=progress, success=no_success(progress), log_prob=log_prob)

    def _progress(self, log_probs: Float32Array, num_frames: int) -> Any:
        is_robometer = self.collator.config.variant == "robometer"
        values = log_probs.astype(np.float64) if is_robometer else log_probs
        least, most = values.min(), values.max()
        if least == most or (is_robometer and num_frames <= FRAMES_PER_GROUP):
            return np.ones_like(values)
        return ((values - least) / (most - least)).clip(0, 1)


def _unjoined(log_probs: Float32Array) -> FrameScores:
    unknown = np.full_like(log_probs, np.nan)  # progress is known once all rows are
    return FrameScores(progress=unknown, success=unknown, log_prob=log_probs)


@dataclass(frozen=True)
class TopRewardCheckpoint(LanguageCheckpoint):
    """A TOPReward model in memory."""

    made_of = TopRewardConfig
    predictor_of = TopRewardPredictor
    collator_of = TopRewardCollator

    @property
    def description(self) -> Description:
        """The model's inputs and outputs."""
        return self.described(
            f"TOPReward, as {'LeRobot' if self.config.variant == 'lerobot' else 'Robometer'} computes it",
            network_frames=self.config.max_frames,
            more_scores=("log_prob",),
            needs_whole_episode=True,
        )

    def images(self, patch_px: int, normalisation: Normalisation) -> QwenImages:
        """Return the preprocessing of videos, as this variant has it."""
        return TopRewardImages(patch_px, normalisation, config=self.config)
