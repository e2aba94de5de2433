# SPDX-License-Identifier: MIT
"""Advantages from progress, for advantage-conditioned and weighted imitation: the rule of RECAP.

Physical Intelligence, "pi*0.6: a VLA That Learns From Experience" (arXiv 2511.14759): over N steps,
A(t) = r(t) + ... + r(t+N-1) + V(t+N) - V(t). Each step costs 1, and values are divided by the length of the task's
longest episode, so that they lie between -1 and 0. Here V is progress - 1, which is 0 at the finished task.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from rfm_client import Float32Array
from rfm_labels.datasets.dataset import DatasetEpisode

RECAP = "recap"  # the rule's name in the provenance


def most_steps(episodes: Iterable[DatasetEpisode]) -> Mapping[str, int]:
    """Return, by task, the steps between the first and the last frame of the task's longest stretch, at least 1."""
    steps: dict[str, int] = {}
    for episode in episodes:
        for task, num_frames in episode.stretches:
            steps[task] = max(steps.get(task, 1), num_frames - 1)
    return steps


def recap_advantages(progress: Float32Array, horizon: int, steps: int) -> Float32Array:
    """Return each frame's advantage, float32 [T]: the progress gained, less the time it took.

    A(t) = progress(u) - progress(t) - (u - t) / steps, where u is ``horizon`` frames after t, or the last frame. It is
    0 at the last frame, and where progress rises as slowly as in a success that takes all ``steps``.

    progress: float32 [T], without NaN, of a stretch of frames with one task
    horizon: N, in frames
    steps: of the task's longest episode, as ``most_steps`` returns them
    """
    now = np.arange(len(progress))
    later = np.minimum(now + horizon, len(progress) - 1)
    values = progress.astype(np.float64)
    advantages: Float32Array = (values[later] - values[now] - (later - now) / steps).astype(np.float32)
    return advantages
