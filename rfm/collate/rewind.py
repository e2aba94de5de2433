# SPDX-License-Identifier: MIT
"""Samples -> rows -> padded batches for the ReWiND transformer.

A row is one token sequence of one forward: a sample is one row, and in dense mode one row per frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from rfm.collate import as_tensor
from rfm.models.rewind import RewindBatch, RewindConfig
from rfm_client import InvalidSampleError, ProgressSample, Sample, SimilaritySample, Trajectory
from rfm_client.samples import Float32Array
from rfm_client.wire import pad_stack


@dataclass(frozen=True, eq=False)
class Row:
    """One token sequence: text [Dt], first [T, Dv], and in a question about two trajectories second [T, Dv].

    picked: in dense mode int64 [K], the frames of ``first`` that the row is about; None: all
    """

    text: Float32Array
    first: Float32Array
    second: Float32Array | None = None
    is_similarity: bool = False
    picked: npt.NDArray[np.int64] | None = None

    @property
    def num_first(self) -> int:
        """Frames of the first trajectory in the row."""
        return len(self.first if self.picked is None else self.picked)

    @property
    def num_second(self) -> int:
        """Frames of the second trajectory in the row, 0 without one."""
        return 0 if self.second is None else len(self.second)


def prefix_indices(num_frames: int, frame_steps: int) -> npt.NDArray[np.int64]:
    """Dense mode: int64 [T, K], the frames that stand for each prefix 0..t.

    K positions evenly from 0 to t, truncated to whole frames, as the original server samples them.
    """
    return np.stack([np.linspace(0, t, frame_steps).astype(np.int64) for t in range(num_frames)])


@dataclass(frozen=True)
class RewindCollator:
    """What a checkpoint can take of a sample, and how a batch of it looks."""

    config: RewindConfig

    def rows(self, sample: Sample) -> list[Row]:
        """The rows of a sample of embeddings. Raises InvalidSampleError if the checkpoint cannot score it."""
        if isinstance(sample, SimilaritySample) and not self.config.has_similarity:
            supported = "progress or preference (this checkpoint has no similarity head)"
            raise InvalidSampleError.at("sample_type", supported, "similarity")
        frame_steps = sample.frame_steps if isinstance(sample, ProgressSample) else 0
        text = self._text(sample.trajectories[0])
        videos = [self._video(trajectory, frame_steps) for trajectory in sample.trajectories]
        if frame_steps:
            return [Row(text, videos[0], picked=picked) for picked in prefix_indices(len(videos[0]), frame_steps)]
        if len(videos) == 1:
            return [Row(text, videos[0])]
        return [Row(text, videos[0], videos[1], isinstance(sample, SimilaritySample))]

    def collate(self, rows: Sequence[Row]) -> RewindBatch:
        """A batch of rows that all have, or all lack, a second trajectory."""
        firsts = [row.first if row.picked is None else row.first[row.picked] for row in rows]
        seconds = [row.second for row in rows if row.second is not None]
        return RewindBatch(
            text=as_tensor(np.stack([row.text for row in rows])),
            first=as_tensor(pad_stack(firsts)),
            second=as_tensor(pad_stack(seconds)) if seconds else None,
            token_mask=self._token_mask(firsts, seconds),
            is_similarity=torch.tensor([row.is_similarity for row in rows]) if seconds else None,
        )

    def _token_mask(self, firsts: Sequence[Float32Array], seconds: Sequence[Float32Array]) -> Tensor | None:
        """bool [B, L], false at the tokens of padding frames; None when no row is padded."""
        always = torch.ones(len(firsts), 1, dtype=torch.bool)
        mask = [always]
        for videos in (firsts, seconds):
            lengths = torch.tensor([len(video) for video in videos])
            if len(videos):
                frames = torch.arange(int(lengths.max())) < lengths[:, None]
                mask.append(frames.repeat_interleave(self.config.tokens_per_frame, dim=1))
        if seconds:
            mask.append(always)
        joined = torch.cat(mask, dim=1)
        return None if bool(joined.all()) else joined

    def _text(self, trajectory: Trajectory) -> Float32Array:
        width = self.config.text_feature_dim
        text = trajectory.text_embedding
        if text is None or text.shape != (width,):
            got = "None" if text is None else str(list(text.shape))
            raise InvalidSampleError.at("text_embedding", f"float32 [{width}]", got)
        return text

    def _video(self, trajectory: Trajectory, frame_steps: int) -> Float32Array:
        """The trajectory's embeddings [T, Dv]."""
        width, limit = self.config.video_feature_dim, self.config.max_frames
        video = trajectory.video_embeddings
        if video is None or video.shape[1] != width:
            got = "frames" if video is None else str(list(video.shape))
            raise InvalidSampleError.at("video_embeddings", f"float32 [T, {width}]", got)
        if limit is not None and (frame_steps or len(video)) > limit:
            where, count = ("frame_steps", frame_steps) if frame_steps else ("num_frames", len(video))
            expected = f"at most {limit} (max_len of this checkpoint, which has per-frame progress tokens)"
            raise InvalidSampleError.at(where, expected, str(count))
        return video
