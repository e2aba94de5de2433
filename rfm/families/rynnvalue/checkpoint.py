# SPDX-License-Identifier: MIT
"""RynnValue's predictor, for the seconds that remain and those since the previous frame, and its checkpoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from rfm.engine.execution import Execution
from rfm.engine.predictor import RowScores, no_success
from rfm.families.rynnvalue.network import RynnConfig, RynnNetwork, RynnOutput, entropy
from rfm.families.rynnvalue.prompts import RELATIVE_TOKEN, VALUE_TOKEN, RynnCollator
from rfm.qwen.batch import VlmRow
from rfm.qwen.language import LanguageCheckpoint
from rfm.qwen.predictor import QwenPredictor
from rfm_client.contract import FrameScores, RewardError
from rfm_client.contract.description import Description
from rfm_client.contract.samples import Float32Array


class RynnPredictor(QwenPredictor):
    """A RynnValue model on a device."""

    collator: RynnCollator
    has_progress = False

    @torch.inference_mode()
    def score(self, rows: Sequence[VlmRow], batch: Any, execution: Execution) -> list[RowScores | RewardError]:
        """Run one forward pass; return the rows' scores."""
        output = self._output(batch)
        remaining_s, entropies, relative_s, may_keep = self._read(output)
        if may_keep:
            self._keep(rows, batch.layout, output.made)
        counts = np.array([self.collator.num_groups(row) for row in rows])
        of_values, of_relatives = np.cumsum(counts, axis=0)[:-1].T
        parts = np.split(remaining_s, of_values), np.split(entropies, of_values), np.split(relative_s, of_relatives)
        return [
            RowScores([_scores(*part)], is_of_prefixes=row.picked is not None)
            for row, *part in zip(rows, *parts, strict=True)
        ]

    def _read(self, output: RynnOutput) -> tuple[Float32Array, Float32Array, Float32Array, bool]:
        """Return remaining seconds, entropies, relative seconds, and True if the pass's features are finite.

        A single copy from the device reads them all.
        """
        made = torch.zeros(1) if output.made is None else output.made
        found = {
            "remaining_s": self.collator.config.value_bins.seconds(output.values).mean(0),
            "entropy": entropy(output.values).mean(0),
            "relative_s": self.collator.config.relative_bins.seconds(output.relatives),
        }
        is_finite = made.isfinite().all().float()[None].to(found["entropy"].device)
        ends = np.cumsum([*map(len, found.values())])
        remaining_s, entropies, relative_s, kept = np.split(torch.cat([*found.values(), is_finite]).cpu().numpy(), ends)
        return remaining_s, entropies, relative_s, bool(kept[0])


def _scores(remaining_s: Float32Array, entropies: Float32Array, relative_s: Float32Array) -> FrameScores:
    """Return frame scores. A first frame has no relative value: no time has passed."""
    unknown = no_success(remaining_s)
    missing = np.zeros(len(remaining_s) - len(relative_s), np.float32)
    return FrameScores(
        progress=unknown,
        success=unknown,
        remaining_s=remaining_s,
        relative_s=np.concatenate([missing, relative_s]),
        entropy=entropies,
    )


TRAINED_FRAMES = 8


@dataclass(frozen=True)
class RynnCheckpoint(LanguageCheckpoint):
    """A RynnValue model in memory."""

    made_of = RynnConfig
    network_of = RynnNetwork
    predictor_of = RynnPredictor
    collator_of = RynnCollator
    has_language_head: ClassVar[bool] = False
    reads_videos: ClassVar[bool] = False

    @property
    def description(self) -> Description:
        """The model's inputs and outputs."""
        return self.described(
            "RynnValue",
            trained_frames=TRAINED_FRAMES,
            trained_padding=False,
            has_progress=False,
            more_scores=("remaining_s", "relative_s", "entropy"),
            uses_graphs=self.config.attention == "causal",  # otherwise the groups need a mask
        )

    @property
    def own_tokens(self) -> dict[str, int]:
        """The value tokens and their ids."""
        return {VALUE_TOKEN: self.config.value_token, RELATIVE_TOKEN: self.config.relative_token}
