# SPDX-License-Identifier: MIT
"""Episode motions: done well, done wrong, dropped, stopped half-way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from toy_world.episode import CARRY_Y, NOTHING, Episode
from toy_world.scene import BLOCK_SIZE, IN_TARGET_Y, REST_Y, Float64Array, Scene
from toy_world.tasks import COLOURS, Task

KINDS = ("success", "wrong_object", "wrong_target", "dropped", "stopped")
FAILURES = KINDS[1:]
_STEP = 0.03  # gripper distance per moment, at speed 1
_FALL = 0.12  # distance per moment that a block falls
_MAX_PAUSE = 4  # moments
_STOPPED_PROGRESS = (0.08, 0.72)  # where an episode may stop
_HOVER_Y = (0.35, CARRY_Y)


@dataclass
class _Path:
    """The gripper's path so far: positions, and whether it is closed there."""

    random: np.random.Generator
    points: list[Float64Array]
    closed: list[bool]

    def move(self, x: float, y: float) -> None:
        """Move at a random speed along a random curve, monotonically on both axes."""
        start, end = self.points[-1], np.array([x, y])
        count = max(2, round(np.abs(end - start).sum() / (_STEP * self.random.uniform(0.6, 1.6))))
        shares = np.linspace(0, 1, count + 1)[1:, None] ** self.random.uniform(0.6, 1.6, 2)
        self.points += list(start + (end - start) * shares)
        self.closed += [self.closed[-1]] * count

    def grip(self, closed: bool) -> None:
        """Open or close the gripper, and wait a little."""
        count = 1 + int(self.random.integers(_MAX_PAUSE))
        self.points += [self.points[-1]] * count
        self.closed += [closed] * count


def random_episode(kind: str, task: Task, scene: Scene, random: np.random.Generator) -> Episode:
    """Make an episode for ``task``; ``kind`` is one of KINDS."""
    block, target = float(scene.blocks[task.block_index]), float(scene.targets[task.target_index])
    if kind == "wrong_object":
        others = [i for i in range(len(COLOURS)) if i != task.block_index and scene.has_block(i)]
        block = float(scene.blocks[random.choice(others)])
    if kind == "wrong_target":
        target = float(scene.targets[1 - task.target_index])
    path = _Path(random, [scene.gripper], [False])
    path.move(block, random.uniform(*_HOVER_Y))
    path.move(block, REST_Y)
    path.grip(True)
    hover_y = random.uniform(*_HOVER_Y)
    path.move(block, hover_y)
    if kind == "dropped":
        _carry_and_drop(path, block, target, scene)
    else:
        path.move(target, hover_y)
        path.move(target, IN_TARGET_Y)
        path.grip(False)
        path.move(target + random.uniform(-0.05, 0.05), random.uniform(0.3, CARRY_Y))
    episode = _simulated(scene, np.stack(path.points), np.array(path.closed))
    return _stopped(episode, task, random) if kind == "stopped" else episode


def pick_and_place(scene: Scene, grasp_x: float, release_x: float, random: np.random.Generator) -> Episode:
    """Close the gripper above one table position and open it above another. Only a block within reach is grasped."""
    path = _Path(random, [scene.gripper], [False])
    path.move(grasp_x, CARRY_Y)
    path.move(grasp_x, REST_Y)
    path.grip(True)
    path.move(grasp_x, CARRY_Y)
    path.move(release_x, CARRY_Y)
    path.move(release_x, IN_TARGET_Y)
    path.grip(False)
    path.move(release_x, CARRY_Y)
    return _simulated(scene, np.stack(path.points), np.array(path.closed), reach=BLOCK_SIZE / 2)


def resting(scene: Scene) -> Episode:
    """The one moment before anything moves."""
    return _simulated(scene, scene.gripper[None], np.array([False]))


def _carry_and_drop(path: _Path, block: float, target: float, scene: Scene) -> None:
    """Drop the block on the way, where the table is free. Then move on without it, or move up."""
    random, y = path.random, float(path.points[-1][1])
    shares = random.permutation(np.linspace(0.1, 0.85, 16))
    standing = np.array([*scene.targets, *scene.blocks[~np.isnan(scene.blocks)]])
    room = [np.abs(block + (target - block) * share - standing).min() for share in shares]
    drop_x = block + (target - block) * shares[int(np.argmax(np.array(room) > 0.08))]
    if abs(drop_x - target) < 0.08:
        drop_x = (block + target) / 2
    path.move(drop_x, y)
    path.grip(False)
    if random.random() < 0.5:
        path.move(target, y)
        path.move(target, random.uniform(y, IN_TARGET_Y))
    else:
        path.move(drop_x + random.uniform(-0.1, 0.1), random.uniform(0.15, 0.3))


def _simulated(scene: Scene, gripper: Float64Array, is_closed: np.ndarray, reach: float = np.inf) -> Episode:
    """Simulate the blocks along the gripper's path: they are held, or they fall.

    reach: largest distance at which the gripper can grasp a block
    """
    blocks = np.stack([scene.blocks, np.where(np.isnan(scene.blocks), np.nan, REST_Y)], axis=1)
    history = np.empty((len(gripper), *blocks.shape))
    held = np.full(len(gripper), NOTHING)
    for moment, position in enumerate(gripper):
        if is_closed[moment]:
            held[moment] = held[moment - 1]
            if held[moment] == NOTHING:
                away = np.abs(blocks - position).sum(axis=1)
                nearest = int(np.nanargmin(away))
                held[moment] = nearest if away[nearest] <= reach else NOTHING
            if held[moment] != NOTHING:
                blocks[held[moment]] = position
        elif (blocks[:, 1] < REST_Y).any():
            in_target = np.abs(blocks[:, :1] - scene.targets).min(axis=1) < BLOCK_SIZE
            floor = np.where(in_target, IN_TARGET_Y, REST_Y)
            blocks[:, 1] = np.minimum(blocks[:, 1] + _FALL, np.maximum(floor, blocks[:, 1]))
        history[moment] = blocks
    return Episode(scene, gripper, is_closed, history, held)


def _stopped(episode: Episode, task: Task, random: np.random.Generator) -> Episode:
    """Cut the episode at a moment half-way, and hold that state to the end."""
    low, high = _STOPPED_PROGRESS
    progress = episode.progress(task)
    halfway = np.flatnonzero((progress > low) & (progress < high))
    last = int(random.choice(halfway))
    return episode.at(np.minimum(np.arange(len(episode)), last))
