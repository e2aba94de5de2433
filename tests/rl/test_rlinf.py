# SPDX-License-Identifier: MIT
"""Rewards in RLinf: its reward input, scored by a real server.

RLinf is not installed here: ``rlinf`` is a fake with its base class and its registry, the two names that the module
imports. The inputs have the shapes of RLinf 0.3.0.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from environments import MODEL, assert_close
from rfm_client import InvalidSampleError, RewardClient
from servers import Served

pytestmark = pytest.mark.triton

TASKS = ["stack the cups", "open the drawer", "fold the towel"]
VIDEOS = [np.random.default_rng(env).integers(0, 256, (5, 48, 64, 3), np.uint8) for env in range(3)]
NO_TASK_SINCE = r"task_descriptions\[1\]: expected the task of the episode that ended, which RLinf may replace"


class FakeBaseRewardModel(torch.nn.Module):
    """Stand-in for RLinf's base class, which keeps the configuration."""

    def __init__(self, cfg: Any) -> None:
        super().__init__()
        self.cfg = cfg


@pytest.fixture
def rlinf(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """``rfm_rl.rlinf`` over a fake of RLinf."""
    path = "rlinf.models.embodiment.reward"
    parts = path.split(".")
    for count in range(1, len(parts) + 1):
        monkeypatch.setitem(sys.modules, ".".join(parts[:count]), ModuleType(parts[count - 1]))
    monkeypatch.setattr(sys.modules[path], "BaseRewardModel", FakeBaseRewardModel, raising=False)
    monkeypatch.setattr(sys.modules[path], "reward_model_registry", {}, raising=False)
    import rfm_rl.rlinf

    yield rfm_rl.rlinf
    del sys.modules["rfm_rl.rlinf"]


@pytest.fixture
def made(rlinf: Any, served: Served) -> Any:
    """A function that makes the reward model as RLinf does: from the registry, with its ``reward.model``."""

    def make(buffers: Any = None, **options: Any) -> Any:
        rlinf.register()
        registry = sys.modules["rlinf.models.embodiment.reward"].reward_model_registry  # type: ignore[attr-defined]
        options = {"url": served.url("grpc"), "client": {"model": MODEL}, **options}
        return registry["rfm"]({"model_type": "rfm", "num_envs": 3, "history_buffers": buffers or {}, "rfm": options})

    return make


def history(counts: Sequence[int], *, tasks: bool = False, **more: Any) -> dict[str, Any]:
    """RLinf's reward input: the first pictures of each environment."""
    pictures = [
        [torch.from_numpy(picture) for picture in video[:count]] for video, count in zip(VIDEOS, counts, strict=True)
    ]
    buffer: dict[str, Any] = {"main_images": pictures}
    if tasks:
        buffer["task_descriptions"] = [[task] * count for task, count in zip(TASKS, counts, strict=True)]
    return {
        "main_images": torch.zeros((3, 48, 64, 3), dtype=torch.uint8),
        "task_descriptions": TASKS,
        "dones": torch.zeros(3, dtype=torch.bool),
        "history_input": {"episode": buffer},
        **more,
    }


def scored(client: RewardClient, env: int, count: int, task: str | None = None) -> Any:
    with client.episode(task or TASKS[env]) as episode:
        for picture in VIDEOS[env][:count]:
            episode.keep(picture)
        (score,) = client.score_episodes([episode])
    return score


@pytest.mark.parametrize("reward", ["progress", "delta", "success"])
def test_each_environment_is_paid_for_its_pictures_in_one_call(
    made: Any, client: RewardClient, monkeypatch: pytest.MonkeyPatch, reward: str
) -> None:
    """``delta`` pays the change since the picture before, 0 for the first."""
    counts = [5, 3, 1]
    expected = [getattr(scored(client, env, n), reward.replace("delta", "progress")) for env, n in enumerate(counts)]
    if reward == "delta":
        expected = [now - scored(client, env, counts[env] - 1).progress for env, now in enumerate(expected[:2])] + [0.0]
    calls: list[int] = []
    score = RewardClient.score_episodes
    monkeypatch.setattr(
        RewardClient, "score_episodes", lambda self, episodes: calls.append(len(episodes)) or score(self, episodes)
    )
    rewards = made(reward=reward).compute_reward(history(counts))
    assert (rewards.dtype, rewards.shape) == (torch.float32, (3,))
    assert_close(rewards, expected)
    assert calls == [5 if reward == "delta" else 3]


def test_two_cameras_are_fused(made: Any, client: RewardClient) -> None:
    sent = history([5, 3, 1])
    fronts = sent["history_input"]["episode"]["main_images"]
    sent["history_input"]["episode"]["wrist_images"] = [
        [(255 - front)[None, ::2, ::2] for front in video] for video in fronts
    ]
    rewards = made(episode={"cameras": ["main_images", "wrist_images"], "fuse": "min"}).compute_reward(sent)
    with client.episode(TASKS[0], cameras=["front", "wrist"], fuse="min") as episode:
        for front in VIDEOS[0]:
            episode.keep({"front": front, "wrist": 255 - front[::2, ::2]})
        (score,) = client.score_episodes([episode])
    assert_close(rewards[0], score.progress)


def test_an_environment_without_pictures_gets_the_interval_reward(made: Any, client: RewardClient) -> None:
    model = made(interval_reward=-0.5)
    assert_close(model.compute_reward(history([0, 3, 0])), [-0.5, scored(client, 1, 3).progress, -0.5])
    assert_close(model.compute_reward(history([0, 0, 0], history_input={})), [-0.5] * 3)


def test_the_last_picture_of_an_episode_keeps_its_task(made: Any, client: RewardClient) -> None:
    ended = {"dones": torch.tensor([False, True, False]), "task_descriptions": ["a", "the next task", "b"]}
    sent = history([5, 3, 1], tasks=True, **ended)
    sent["history_input"]["episode"]["task_descriptions"][1][-1] = "the next task"
    assert_close(made().compute_reward(sent)[1], scored(client, 1, 3).progress)


@pytest.mark.parametrize("tasks", [False, True], ids=["no task is kept", "only the next task is kept"])
def test_a_task_that_may_be_the_next_episodes_is_refused(made: Any, tasks: bool) -> None:
    ended = history([5, 1, 1], tasks=tasks, dones=torch.tensor([False, True, False]))
    with pytest.raises(InvalidSampleError, match=NO_TASK_SINCE):
        made().compute_reward(ended)
    made(task="stack the cups").compute_reward(ended)
    made().compute_reward(
        {**ended, "task_descriptions": [TASKS[0]] * 3, "history_input": history([1, 1, 1])["history_input"]}
    )


def pictures(**of_cameras: Any) -> dict[str, Any]:
    return {"history_input": {"episode": of_cameras}}


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "tasks": ({"task_descriptions": TASKS[:2]}, "expected as many environments in each part"),
    "camera": (pictures(wrist_images=[[]] * 3), r"history_input\['episode'\]: expected pictures under main_images"),
    "none": ({"task_descriptions": None}, r"task_descriptions\[0\]: expected a sentence, or reward.model.rfm.task"),
    "blank": ({"task_descriptions": ["", "a", "b"]}, r"envs\[0\]"),
    "floats": (pictures(main_images=[[VIDEOS[0][0] / 255], [], []]), r"envs\[0\]"),
    "no history": ({"history_input": None}, r"history_input: expected the history .*reward_mode: history_buffer"),
    "dropped": (
        {"dones": torch.tensor([True, False, False]), "history_input": {}},
        r"envs\[0\]: expected the pictures of the episode that ended",
    ),
}


@pytest.mark.parametrize(("change", "message"), FAULTS.values(), ids=FAULTS)
def test_an_input_at_fault_is_an_error(made: Any, change: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidSampleError, match=message):
        made({"episode": {"input_on_done": True}}).compute_reward(history([5, 3, 1], **change))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"url": None}, "reward.model.rfm.url: expected the server's address"),
        ({"reward": "final"}, "reward.model.rfm.reward: expected one of progress, delta, success"),
        ({"intervall_reward": 1}, "reward.model.rfm: expected the keys url, .* got intervall_reward"),
        ({"episode": {"camera": "x"}}, "camera"),
        ({"client": {"timeout": 1}}, "timeout"),
    ],
)
def test_wrong_options_are_refused_at_the_start(made: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        made(**options)


def test_one_of_several_buffers_is_named(made: Any, client: RewardClient) -> None:
    buffers: dict[str, Any] = {"episode": {}, "newest": {}}
    with pytest.raises(ValueError, match=r"reward.model.rfm.buffer: expected one of episode, newest, got none"):
        made(buffers)
    sent = history([5, 3, 1])
    sent["history_input"]["newest"] = history([1, 1, 1])["history_input"]["episode"]
    assert_close(made(buffers, buffer="newest").compute_reward(sent)[0], scored(client, 0, 1).progress)


def test_the_served_model_is_not_trained(made: Any) -> None:
    model = made()
    assert not list(model.parameters())
    with pytest.raises(NotImplementedError, match="no weights"):
        model.forward(torch.zeros(1))
