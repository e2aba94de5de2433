# SPDX-License-Identifier: MIT
"""Clips to score, with the true scores."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from toy_world.episode import Episode
from toy_world.motion import random_episode
from toy_world.render import UInt8Array, render
from toy_world.scene import Float64Array, Scene, random_scene
from toy_world.tasks import Task

NUM_FRAMES = 16
_TURN_SHARES = (0.7, 1.0)  # where an episode may turn back, as a share of its length
_MIN_REWOUND_SHARE = 0.35  # minimum rewound share


@dataclass(frozen=True, eq=False)
class Clip:
    """A clip with the true scores for ``task``.

    frames: uint8 [T, H, W, 3]; progress: float64 [T], success: bool [T]
    task: the task in the sentence; the video may show another one
    turn: the frame from which the clip runs backwards; T - 1 if it never does
    """

    frames: UInt8Array
    task: Task
    progress: Float64Array
    success: npt.NDArray[np.bool_]
    kind: str
    turn: int


def make_clip(kind: str, task: Task, seed: int, *, shown: Task | None = None, num_frames: int = NUM_FRAMES) -> Clip:
    """Make a clip; ``kind`` is one of KINDS or ``rewound``. Deterministic in the arguments.

    shown: the task that the video shows, if not ``task``
    """
    random = np.random.default_rng(seed)
    shown = shown or task
    scene = random_scene(shown, random)
    if kind == "rewound":
        episode, turn = rewound(random_episode("success", shown, scene, random), num_frames, random)
    else:
        episode, turn = forward(random_episode(kind, shown, scene, random), num_frames), num_frames - 1
    return Clip(render(episode), task, episode.progress(task), episode.success(task), kind, turn)


def forward(episode: Episode, num_frames: int) -> Episode:
    """Sample ``num_frames`` evenly spaced moments."""
    return episode.at(np.linspace(0, len(episode) - 1, num_frames).round().astype(np.int64))


def rewound(episode: Episode, num_frames: int, random: np.random.Generator) -> tuple[Episode, int]:
    """Play an episode forwards, then back, in ``num_frames`` moments. Return it with the frame where it turns.

    ReWiND (https://arxiv.org/abs/2505.10911) trains on such videos: failures that need no failed episode.
    """
    turn = random.uniform(*_TURN_SHARES)
    back = random.uniform(0.0, turn - _MIN_REWOUND_SHARE)
    way = np.linspace(0, turn + (turn - back), num_frames)
    shares = np.where(way > turn, 2 * turn - way, way)
    moments = (shares * (len(episode) - 1)).round().astype(np.int64)
    return episode.at(moments), int(shares.argmax())


__all__ = ["NUM_FRAMES", "Clip", "Scene", "forward", "make_clip", "rewound"]
