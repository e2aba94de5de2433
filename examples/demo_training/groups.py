# SPDX-License-Identifier: MIT
"""Training data: groups of related clips, rendered on demand.

G groups, 4 clips per group (the constants below), T frames per clip, H x W pixels, 6 tasks, S hint values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from toy_world.clips import forward
from toy_world.episode import Episode
from toy_world.motion import FAILURES, random_episode
from toy_world.render import render
from toy_world.scene import random_scene
from toy_world.tasks import COLOURS, TARGETS, TASKS, Task

CLIP_FRAMES = 12
SCATTERED_FRAMES = 3  # per clip while the encoder learns alone: few, so that it sees many scenes
SUCCESS, SECOND_SUCCESS, FAILURE, OTHER_TASK = range(4)  # the clips in a group
HINT_DIM = 3 + 4 * len(COLOURS) + len(TARGETS) + 2 * len(TASKS)
_SAME_SCENE_SHARE = 0.5


class Groups(NamedTuple):
    """G groups of clips, with their true scores.

    frames: uint8 [G, 4, T, H, W, 3]
    task, other_task: int64 [G], tasks for the clips SUCCESS and OTHER_TASK
    progress, success: float32 [G, 4, T, 6], true scores under each task
    hints: float32 [G, 4, T, S], state in a frame: positions (NaN for a missing block), then progress and success for
        each task
    """

    frames: Tensor
    task: Tensor
    other_task: Tensor
    progress: Tensor
    success: Tensor
    hints: Tensor


@dataclass(frozen=True)
class GroupsDataset(Dataset[Groups]):
    """Yields ``num_steps`` batches with ``groups_per_step`` groups. A seed gives the same groups in any process.

    The first ``scattered_steps`` batches hold equally many frames, from more groups with SCATTERED_FRAMES per clip.
    """

    seed: int
    num_steps: int
    groups_per_step: int
    scattered_steps: int = 0

    def __len__(self) -> int:
        return self.num_steps

    def __getitem__(self, step: int) -> Groups:
        random = np.random.default_rng([self.seed, step])
        scattered = step < self.scattered_steps
        count = self.groups_per_step * (CLIP_FRAMES // SCATTERED_FRAMES if scattered else 1)
        groups = [_group(random, scattered=scattered) for _ in range(count)]
        return Groups(*(torch.from_numpy(np.stack(parts)) for parts in zip(*groups, strict=True)))


def _group(random: np.random.Generator, *, scattered: bool) -> tuple[np.ndarray, ...]:
    task_index = int(random.integers(len(TASKS)))
    task = TASKS[task_index]
    scene, second_scene, third_scene = (random_scene(task, random) for _ in range(3))
    others = [i for i, other in enumerate(TASKS) if i != task_index and scene.has_block(other.block_index)]
    same = random.random() < _SAME_SCENE_SHARE
    other_index = int(random.choice(others) if same else random.choice(np.delete(np.arange(len(TASKS)), task_index)))
    other_scene = scene if same else random_scene(TASKS[other_index], random)
    failure_scene = scene if random.random() < _SAME_SCENE_SHARE else third_scene
    episodes = [
        random_episode("success", task, scene, random),
        random_episode("success", task, second_scene, random),
        random_episode(str(random.choice(FAILURES)), task, failure_scene, random),
        random_episode("success", TASKS[other_index], other_scene, random),
    ]
    clips = [_scattered(episode, random) if scattered else forward(episode, CLIP_FRAMES) for episode in episodes]
    progress, success = (
        np.stack([_under_tasks(clip, truth) for clip in clips]) for truth in (Episode.progress, Episode.success)
    )
    return (
        np.stack([render(clip) for clip in clips]),
        np.int64(task_index),
        np.int64(other_index),
        progress,
        success,
        np.concatenate([np.stack([_state(clip) for clip in clips]), progress, success], axis=-1),
    )


def _scattered(episode: Episode, random: np.random.Generator) -> Episode:
    return episode.at(random.integers(len(episode), size=SCATTERED_FRAMES))


def _under_tasks(clip: Episode, truth: Callable[[Episode, Task], np.ndarray]) -> np.ndarray:
    """Return true scores under each task, float32 [T, 6]."""
    return np.stack([truth(clip, task) for task in TASKS], axis=1).astype(np.float32)


def _state(clip: Episode) -> np.ndarray:
    """Return float32 [T, 17]: gripper, blocks, held block, present blocks, targets."""
    held = clip.held[:, None] == np.arange(len(COLOURS))
    there = ~np.isnan(clip.blocks[:, :, 0])
    targets = np.broadcast_to(clip.scene.targets, (len(clip), len(TARGETS)))
    blocks = clip.blocks.reshape(len(clip), -1)
    parts = (clip.gripper, clip.is_closed[:, None], blocks, held, there, targets)
    return np.concatenate(parts, axis=1).astype(np.float32)
