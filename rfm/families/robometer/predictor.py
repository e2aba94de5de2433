# SPDX-License-Identifier: MIT
"""The RFM and Robometer predictor: scores for frames and pairs, from one forward pass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from rfm.engine.execution import Execution
from rfm.engine.layers import progress_from_logits
from rfm.engine.predictor import RowScores, no_success
from rfm.families.robometer.network import VlmOutput
from rfm.qwen.batch import VlmBatch, VlmRow
from rfm.qwen.images import FRAMES_PER_GROUP
from rfm.qwen.predictor import QwenPredictor
from rfm_client.contract import FrameScores, RewardError


class VlmPredictor(QwenPredictor):
    """RFM or Robometer on a device."""

    @torch.inference_mode()
    def score(self, rows: Sequence[VlmRow], batch: VlmBatch, execution: Execution) -> list[RowScores | RewardError]:
        """Run one forward pass; return each row's scores or error."""
        output = self._output(batch)
        scores, preference, similarity, may_keep = _read(output)
        of_rows, read, num_queries = [], 0, 0
        for row in rows:
            if row.packs:
                prefixes = slice(read, read + len(row.leaves) + 1)
                of_rows.append(RowScores([scores.at(prefixes)], is_of_prefixes=True))
                read = prefixes.stop
                continue
            frames = []
            for spans, video in zip(row.spans, row.videos, strict=True):
                frames.append(self._per_frame(scores.at(slice(read, read + len(spans))), video.num_shown))
                read += len(spans)
            query = None
            if row.query is not None:
                query = (similarity if row.is_similarity else preference)[num_queries]
                num_queries += 1
            of_rows.append(RowScores(frames, query))
        if may_keep:
            self._keep(rows, batch.layout, output.made)
        return list(of_rows)

    def _per_frame(self, scores: FrameScores, num_frames: int) -> FrameScores:
        """Return the scores by frame; in video mode both frames in a temporal patch share a score."""
        if self.network.config.multi_image:
            return scores
        return scores.at(np.arange(num_frames) // FRAMES_PER_GROUP)


def _read(output: VlmOutput) -> tuple[FrameScores, list[float], list[float], bool]:
    """Return all frames' scores, preferences, similarities, and True if this pass's new features are finite.

    A single copy from the device reads them all.
    """
    made = {
        "progress": progress_from_logits(output.progress),
        "success": None if output.success is None else output.success.sigmoid(),
        "preference": None if output.preference is None else output.preference.sigmoid(),
        "logits": output.progress if output.progress.shape[-1] > 1 else None,
        "similarity": output.similarity,
        "is_finite": None if output.made is None else output.made.isfinite().all(),
    }
    there = {name: tensor for name, tensor in made.items() if tensor is not None}
    parts = torch.cat([each.float().flatten() for each in there.values()]).cpu()
    split = parts.split([each.numel() for each in there.values()])
    read = {name: part.view(of.shape).numpy() for (name, of), part in zip(there.items(), split, strict=True)}
    progress = read["progress"]
    success = read["success"] if "success" in read else no_success(progress)
    scores = FrameScores(progress=progress, success=success, progress_logits=read.get("logits"))
    preference, similarity = (read[name].tolist() if name in read else [] for name in ("preference", "similarity"))
    return scores, preference, similarity, bool(read.get("is_finite", True))
