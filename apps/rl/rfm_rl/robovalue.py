# SPDX-License-Identifier: MIT
"""An adapter of the RoboValue benchmark that asks a served checkpoint. Needs RoboValue's package, ``vmbmk``.

A query names a frame of a recorded episode. The adapter shows the model the frames up to it, by the sampling rule of
the checkpoint's training, and gives the progress at it. It sends frames and the instruction, nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rfm_client import ProgressSample, RewardClient, Trajectory
from rfm_client.frames import Sampling

try:
    from vmbmk.adapters.base import Adapter, compare_value_difference, require_config
    from vmbmk.adapters.video_inputs import query_view
except ImportError as error:
    raise ImportError(
        "rfm_rl.robovalue needs RoboValue's package vmbmk on the path: PYTHONPATH=RoboValue/src"
    ) from error

__all__ = ["RfmAdapter"]


class RfmAdapter(Adapter):  # type: ignore[misc]  # RoboValue is optional, and so untyped here
    """Values of a served checkpoint, higher for more progress.

    dataset: RoboValue's recorded episodes
    client: what the server is asked with; the adapter closes it
    view: the camera to show
    batch_size: most queries whose frames are in memory at a time
    """

    requires_gpu = False
    requires_checkpoint = False

    def __init__(self, dataset: Any, client: RewardClient, view: str = "front", batch_size: int = 32) -> None:
        self._dataset = dataset
        self._client = client
        self._view = view
        self._batch_size = batch_size

    @classmethod
    def from_config(cls, config: Mapping[str, Any], dataset: Any) -> RfmAdapter:
        """Return the adapter of a run. Raises RoboValue's ConfigurationError for unknown keys.

        config: ``url``, and if need be ``view`` and ``client``, further options of RewardClient
        """
        name = config.get("adapter")
        fields = {"url", "view", "client", "batch_size"}
        require_config(config, name, fields, requires_checkpoint=cls.requires_checkpoint)
        client = RewardClient(config["url"], **config.get("client", {}))
        return cls(dataset, client, config.get("view", "front"), config.get("batch_size", 32))

    def value(self, queries: Sequence[Any]) -> list[float]:
        """Return the progress at the frame of each query. Raises RewardError."""
        info = self._client.model_info(frames=True)
        sampling = Sampling.of(None, None, info.max_frames, trained_padding=info.trained_padding)
        values = []
        for start in range(0, len(queries), self._batch_size):
            prefixes = [self._prefix(query, sampling) for query in queries[start : start + self._batch_size]]
            results: list[Any] = self._client.evaluate([sample for sample, _ in prefixes])
            values += [float(result.progress[read]) for result, (_, read) in zip(results, prefixes, strict=True)]
        return values

    def compare(self, queries: Sequence[Any]) -> list[float]:
        """Return the progress at state b minus that at state a, for each query. Raises RewardError."""
        differences: list[float] = compare_value_difference(queries, self.value)
        return differences

    def close(self) -> None:
        """Close the client and its connections."""
        self._client.close()

    def _prefix(self, query: Any, sampling: Sampling) -> tuple[ProgressSample, int]:
        """Return the sample of a query, and the slot of its frame."""
        shown = query_view(self._dataset, query, self._view)
        prefix = sampling.prefix(shown.timeline_anchor(query.state.anchor_frame))
        frames = np.stack([np.asarray(picture) for picture in shown.read_many([int(t) for t in prefix.indices])])
        return ProgressSample(Trajectory(frames=frames, task=query.instruction)), prefix.read
