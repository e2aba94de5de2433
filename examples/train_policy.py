# SPDX-License-Identifier: MIT
"""Train a policy from pixels in the toy world. Its only reward comes from the served demo checkpoint.

    python examples/train_policy.py

The policy sees a scene's first frame. Two colours are its parameters: the gripper closes at the columns most like the
first colour, and opens at the columns most like the second. The cross-entropy method (CEM) tries colours, keeps the
policies with the highest rewards, and samples around them. A step's reward is the served model's progress for the
episode so far. The world's true state serves only to print success rates.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from rfm.serve.triton_server import stopped_by_signals, temporary_server
from rfm_client import RewardClient
from toy_world import Task, forward, pick_and_place, random_scene, render, resting

TASK = Task("red", "plate")
REPOSITORY = Path(__file__).parents[1] / "model_repository"
FRAMES, ELITES, LEAST_SPREAD = 16, 0.15, 8.0  # colours are 0..255
TABLE_ROWS = slice(46, 62)  # frame rows that show blocks, bowl and plate

Rewards = Callable[[np.ndarray, range], tuple[np.ndarray, np.ndarray]]
Policies = np.ndarray  # float64 [P, 2, 3]: RGB for the object to grasp and for the release point


def places(policies: Policies, picture: np.ndarray) -> np.ndarray:
    """Return the columns that best match each policy's colours, float64 [P, 2], as shares of the width W.

    policies: float64 [P, 2, 3]; picture: uint8 [H, W, 3]
    """
    columns = picture[TABLE_ROWS].astype(float)  # [rows, W, 3]
    away = np.abs(columns[None, None] - policies[:, :, None, None]).sum(axis=-1)  # [P, 2, rows, W]
    looks = np.sort(away, axis=2)[:, :, :4].mean(axis=2)  # mean distance over the four nearest rows
    smooth = np.apply_along_axis(np.convolve, 2, -looks, np.ones(7) / 7, "same")[:, :, 4:-4]
    return (smooth.argmax(axis=2) + 4.5) / picture.shape[1]


def rewards(client: RewardClient, policies: Policies, seeds: range) -> tuple[np.ndarray, np.ndarray]:
    """Return each policy's mean reward per step and its success rate, float64 [P] each."""
    videos, successes = [], []
    for seed in seeds:
        scene = random_scene(TASK, np.random.default_rng(seed))
        for grasp_x, release_x in places(policies, render(resting(scene))[0]):
            episode = forward(pick_and_place(scene, grasp_x, release_x, np.random.default_rng(seed)), FRAMES)
            videos.append(render(episode))
            successes.append(episode.success(TASK)[-1])
    episodes = [client.episode(TASK.sentence(), env=number, frames=FRAMES) for number in range(len(videos))]
    steps = []
    for frames in zip(*videos, strict=True):  # one of each video
        for episode, frame in zip(episodes, frames, strict=True):
            episode.keep(frame)
        steps.append([score.progress for score in client.score_episodes(episodes)])
    progress = np.mean(steps, axis=0)
    shape = len(seeds), len(policies)
    return progress.reshape(shape).mean(axis=0), np.reshape(successes, shape).mean(axis=0)


def any_policies(count: int, random: np.random.Generator) -> Policies:
    """Return untrained policies, float64 [count, 2, 3], with random colours."""
    return random.uniform(0, 255, (count, 2, 3))


def train(paid: Rewards, rounds: int, population: int, scenes: int, seed: int) -> np.ndarray:
    """Return CEM's final policy, float64 [2, 3]."""
    random = np.random.default_rng(seed)
    policies = any_policies(population, random)
    for number in range(rounds):
        reward, success = paid(policies, range(1000 * number, 1000 * number + scenes))
        best = policies[np.argsort(reward)[-max(2, int(ELITES * population)) :]]
        mean, spread = best.mean(axis=0), best.std(axis=0) + LEAST_SPREAD
        policies = np.clip(mean + spread * random.standard_normal(policies.shape), 0, 255)
        print(f"round {number + 1:2}: reward {reward.mean():.3f}, success {success.mean():.2f}", flush=True)
    return mean


def main(
    rounds: Annotated[int, typer.Option(help="Of CEM.")] = 10,
    population: Annotated[int, typer.Option(help="Policies of a round.")] = 40,
    scenes: Annotated[int, typer.Option(help="Episodes of each policy in a round.")] = 3,
    tests: Annotated[int, typer.Option(help="Scenes that training did not see, to tell success.")] = 50,
    seed: Annotated[int, typer.Option(help="Of the policies.")] = 0,
    log: Annotated[Path, typer.Option(help="File for Triton's log.")] = Path("tritonserver.log"),
) -> None:
    """Print success rates before and after training."""
    with (
        stopped_by_signals(),
        temporary_server(REPOSITORY, log) as endpoints,
        RewardClient(endpoints.grpc_url) as client,
    ):
        paid = partial(rewards, client)
        untrained = any_policies(20, np.random.default_rng(seed + 1))
        trained = train(paid, rounds, population, scenes, seed)
        held_out = range(10**6, 10**6 + tests)
        _, before = paid(untrained, held_out[: max(tests // 5, 1)])
        _, after = paid(trained[None], held_out)
        print(f"success of untrained policies: {before.mean():.2f}; of the trained one: {after.mean():.2f}")


if __name__ == "__main__":
    typer.run(main)
