# SPDX-License-Identifier: MIT
"""The predictor for reward models on a Qwen backbone: samples of raw frames in, conversation scores out."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import torch

from rfm.engine.device import Copies, memory_errors
from rfm.engine.execution import Execution
from rfm.engine.feature_cache import FeatureCache
from rfm.engine.graphs import Graphs
from rfm.engine.layers import speed_up
from rfm.engine.predictor import Predictor, RowScores
from rfm.engine.threads import FrameThreads
from rfm.qwen.batch import Layout, VlmBatch, VlmRow
from rfm.qwen.collator import QwenCollator
from rfm.qwen.tree import trees
from rfm_client.contract import InvalidSampleError, RewardError, Sample


class QwenPredictor(Predictor[VlmRow, VlmBatch]):
    """A reward model on a Qwen backbone, on a device. A family implements ``score``.

    cache: holds frames, which requests may name, and temporal patch features; None: no cache
    threads: prepare the frames of all samples
    """

    works_ahead = True

    def __init__(
        self, network: Any, collator: QwenCollator, device: torch.device, cache: FeatureCache[Any] | None = None
    ) -> None:
        self.network = network.to(device).eval()
        speed_up(self.network)
        self.collator = collator
        self.device = device
        self.cache = cache
        self.threads = FrameThreads.of(device)
        self._copies = Copies(device)
        self._dtype = next(network.parameters()).dtype
        self._max_tokens = int(network.model.config.get_text_config().max_position_embeddings)

    @property
    def has_success(self) -> bool:
        return bool(self.network.config.has_success)

    def use_graphs(self, graphs: Graphs) -> None:
        """Score small batches with CUDA graphs from now on."""
        self.network.graphs = graphs

    def rows(self, sample: Sample) -> list[VlmRow]:
        """Return the conversations for a sample. Raises InvalidSampleError."""
        rows = self.collator.rows(sample)
        # The backbone has not learned positions beyond this limit, so scores would mean nothing.
        longest = max(row.num_tokens for row in rows)
        if longest > self._max_tokens:
            expected = f"at most {self._max_tokens} tokens (max_position_embeddings of this checkpoint)"
            raise InvalidSampleError.at("num_frames", expected, f"{longest} tokens")
        if not self.collator.makes_trees:
            return rows
        return trees(rows, self.collator.visual_pad, are_images=self.collator.config.multi_image)

    def num_tokens(self, row: VlmRow) -> int:
        return row.cost

    def sequences(self, row: VlmRow) -> Sequence[VlmRow]:
        return row.alone or (row,)

    def work_ahead(self, rows: Sequence[VlmRow]) -> None:
        """Resize the frames whose features are not cached, and start copying them to the device."""
        for video in (video for row in rows for video in row.videos):
            if video.sized is None:
                sized = self.collator.to_size(video, self.cache, self.threads)
                video.sized = replace(sized, pixels=self._copies.send(sized.pixels))

    def collate(self, rows: Sequence[VlmRow]) -> VlmBatch:
        self.work_ahead(rows)
        graphs = self.network.graphs
        length = None if graphs is None else graphs.padded(len(rows), max(row.num_tokens for row in rows))
        batch = self.collator.collate(rows, length)
        return batch.pinned() if self._copies.pins else batch

    def count(self, batch: VlmBatch, execution: Execution) -> None:
        """Count tokens, without and with padding, encoded frames, and frames with cached features."""
        execution.add_tokens(batch.num_tokens, batch.num_slots)
        execution.num_encoded += 0 if batch.pixels is None else batch.pixels.num_shown
        execution.num_found += len(batch.layout.kept) * self.collator.frames_per_shot
        execution.cache_bytes = None if self.cache is None else self.cache.num_bytes

    def score(self, rows: Sequence[VlmRow], batch: VlmBatch, execution: Execution) -> list[RowScores | RewardError]:
        raise NotImplementedError

    def _output(self, batch: VlmBatch, *arguments: Any) -> Any:
        """Return the network's output. Out of memory, free caches and graphs: the engine retries with fewer rows."""
        self._copies.wait_for([video for videos in batch.pixels.videos for video in videos] if batch.pixels else [])
        try:
            with memory_errors():
                return self.network(batch.to(self.device, self._dtype), *arguments)
        except torch.OutOfMemoryError:
            if self.cache is not None:
                self.cache.clear()
            if self.network.graphs is not None:
                self.network.graphs.clear()
            raise

    def _keep(self, rows: Sequence[VlmRow], layout: Layout, made: torch.Tensor | None) -> None:
        """Cache the videos' frames and new features; skip videos larger than the cache."""
        cache = self.cache
        if cache is None:
            return
        with suppress(torch.OutOfMemoryError), memory_errors():  # the scores are complete without the cache
            for video in dict.fromkeys(video for row in rows for video in row.videos):
                frames = dict(zip(video.digests, video.frames, strict=True))
                if sum(frame.nbytes for frame in frames.values()) > cache.limit_bytes:
                    continue
                for digest in frames.keys() - cache.found(frames).keys():
                    cache.keep({digest: frames[digest].copy()})
                for key in video.ready.keys.values():
                    if made is not None and key in layout.made:
                        cache.keep({key: made[layout.made[key]].clone()})
