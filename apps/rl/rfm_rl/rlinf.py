# SPDX-License-Identifier: MIT
"""An RLinf reward model whose rewards come from a served checkpoint. Needs RLinf.

    export RLINF_EXT_MODULE=rfm_rl.rlinf

Each RLinf worker then calls ``register``, and ``reward.model.model_type: rfm`` selects RfmRewardModel. Its options
stand under ``reward.model.rfm``.

With ``reward.reward_mode: history_buffer``, RLinf sends ``history_input[buffer][key][env][t]``: an environment's
pictures since its episode began, or the last ``history_size`` of them. Other modes, which send one picture without
its past, are refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, fields
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from rfm_client import InvalidSampleError, RewardClient, UInt8Array, as_array
from rfm_client.episodes import Episode, EpisodeOptions, StepScore
from rfm_client.options import checked_finite, require

try:
    import torch
    from rlinf.models.embodiment.reward import BaseRewardModel, reward_model_registry
except ImportError as error:
    raise ImportError("rfm_rl.rlinf needs RLinf with its extra embodied: pip install 'rlinf[embodied]'") from error

__all__ = ["RfmRewardModel", "RfmRewardOptions", "register"]

MODEL_TYPE = "rfm"
TASKS = "task_descriptions"
HISTORY = "history_input"
_WHERE = "reward.model.rfm"
_KEEP_TASKS = f"add {TASKS} to history_keys of the buffer, or set {_WHERE}.task"

Reward: TypeAlias = Literal["progress", "delta", "success"]


@dataclass(frozen=True, kw_only=True)
class RfmRewardOptions:
    """The options under ``reward.model.rfm``. Raises ValueError for invalid ones.

    url: server address, or a list of addresses
    client: further options for RewardClient, such as ``timeout_s``
    episode: options for ``RewardClient.episode``. ``cameras``, by default ``main_images``, are observation keys
    reward: ``progress`` at the newest picture; ``delta``: its change since the picture before, 0 at the first picture
        in a window; ``success``: the probability that the task is done
    task: the task for all environments, instead of ``task_descriptions``
    buffer: the history buffer to score, if there are several
    interval_reward: reward for an environment for which RLinf sends no pictures in this step
    """

    url: str | Sequence[str]
    client: Mapping[str, Any] = field(default_factory=dict)
    episode: Mapping[str, Any] = field(default_factory=dict)
    reward: Reward = "progress"
    task: str | None = None
    buffer: str | None = None
    interval_reward: float = 0.0

    def __post_init__(self) -> None:
        choices = ", ".join(get_args(Reward))
        require(f"{_WHERE}.reward", self.reward in get_args(Reward), f"one of {choices}", repr(self.reward))
        checked_finite(f"{_WHERE}.interval_reward", self.interval_reward)
        object.__setattr__(self, "episode", {"cameras": ["main_images"], **self.episode})
        EpisodeOptions(**self.episode)

    @classmethod
    def of(cls, model: Mapping[str, Any]) -> RfmRewardOptions:
        """Return the options in RLinf's ``reward.model``. Raises ValueError."""
        stated = _plain(model.get("rfm") or {})
        names = [each.name for each in fields(cls)]
        unknown = sorted(set(stated) - set(names))
        require(_WHERE, not unknown, f"the keys {', '.join(names)}", ", ".join(unknown))
        require(f"{_WHERE}.url", bool(stated.get("url")), "the server's address, such as grpc://host:8001", "none")
        return cls(**stated)

    @property
    def cameras(self) -> Sequence[str]:
        """The keys of the pictures."""
        return tuple(self.episode["cameras"])


@dataclass(frozen=True)
class _Window:
    """The pictures that RLinf sends for an environment in a step, in order of time."""

    env: int
    task: str
    frames: list[dict[str, UInt8Array]]


class RfmRewardModel(BaseRewardModel):  # type: ignore[misc]  # RLinf is optional, and so untyped here
    """A reward model without weights: a server scores the pictures from all environments in one call.

    cfg: RLinf's ``reward.model``. Raises ValueError for invalid options.
    """

    def __init__(self, cfg: Any) -> None:
        super().__init__(cfg)
        self.options = RfmRewardOptions.of(cfg)
        buffers = cfg.get("history_buffers") or {}
        self._buffer = _chosen(self.options.buffer, list(buffers))
        buffer = buffers.get(self._buffer) or {}
        self._sends_ends = bool(buffer.get("input_on_done")) and (buffer.get("min_history_size") or 0) <= 1
        self._tasks: set[str] = set()
        self._client = RewardClient(self.options.url, **self.options.client)

    def forward(self, input_data: Any, labels: Any = None) -> dict[str, Any]:
        """Raise NotImplementedError: the server's model is not trained here."""
        raise NotImplementedError("RfmRewardModel has no weights to train: its rewards come from a server")

    def compute_reward(self, observations: Mapping[str, Any]) -> torch.Tensor:
        """Return the rewards for all environments, float32 [B]. Raises RewardError.

        observations: RLinf's reward input. An environment without pictures gets ``interval_reward``
        """
        pictures = self._pictures(observations)
        rewards = torch.full((_num_envs(observations, pictures),), float(self.options.interval_reward))
        windows = self._windows(observations, pictures)
        for window, reward in zip(windows, self._rewards(windows), strict=True):
            rewards[window.env] = reward
        return rewards

    def _pictures(self, observations: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the values by key, environment and time; empty: RLinf sends none in this step."""
        history = observations.get(HISTORY)
        expected = "the history of each environment (set reward.reward_mode: history_buffer)"
        require(HISTORY, history is not None, expected, "none", InvalidSampleError)
        assert history is not None
        found: Mapping[str, Any] = history.get(_chosen(self._buffer, list(history)), {})
        has_all = not found or found.keys() >= set(self.options.cameras)
        expected = f"pictures under {', '.join(self.options.cameras)} ({_WHERE}.episode.cameras; history_keys)"
        require(f"{HISTORY}[{self._buffer!r}]", has_all, expected, ", ".join(found), InvalidSampleError)
        return found

    def _windows(self, observations: Mapping[str, Any], pictures: Mapping[str, Any]) -> list[_Window]:
        """Return a window for each environment that has pictures."""
        dones = observations.get("dones")
        self._tasks.update(map(str, observations.get(TASKS) or ()))
        windows = []
        for env in range(_num_envs(observations, pictures)):
            is_done = dones is not None and bool(dones[env])
            columns = {key: pictures[key][env] if pictures else [] for key in self.options.cameras}
            counts = {len(column) for column in columns.values()}
            require(_of(env), len(counts) == 1, "as many pictures of each camera", sorted(counts), InvalidSampleError)
            (count,) = counts
            if count:
                frames = [{key: _image(column[t]) for key, column in columns.items()} for t in range(count)]
                kept = pictures[TASKS][env] if TASKS in pictures else None
                windows.append(_Window(env, self._task(env, observations.get(TASKS), kept, is_done), frames))
            elif is_done and self._sends_ends:
                expected = "the pictures of the episode that ended (RLinf drops them if environments of several "
                expected += "env workers end in different steps: set input_interval: 1)"
                require(_of(env), False, expected, "none", InvalidSampleError)
        return windows

    def _task(self, env: int, stated: Sequence[str] | None, kept: Sequence[str] | None, is_done: bool) -> str:
        """Return the task for an environment's pictures.

        In the step that ends an episode, RLinf may state the next episode's task.
        """
        if self.options.task is not None:
            return self.options.task
        tasks = list(kept or ())[: -1 if is_done else None]
        if not tasks:
            where = f"{TASKS}[{env}]"
            require(where, stated is not None, f"a sentence, or {_WHERE}.task", "none", InvalidSampleError)
            is_sure = not is_done or len(self._tasks) == 1
            expected = f"the task of the episode that ended, which RLinf may replace by the next one's ({_KEEP_TASKS})"
            require(where, is_sure, expected, f"{len(self._tasks)} tasks so far", InvalidSampleError)
            return str((stated or ())[env])
        require(_of(env), len(set(tasks)) == 1, "one task", sorted(set(tasks)), InvalidSampleError)
        return str(tasks[0])

    def _rewards(self, windows: Sequence[_Window]) -> list[float]:
        """Return each window's reward, all from one call."""
        past = [window for window in windows if len(window.frames) > 1] if self.options.reward == "delta" else []
        with ExitStack() as stack:
            episodes = [stack.enter_context(self._episode(window, len(window.frames))) for window in windows]
            before = [stack.enter_context(self._episode(window, len(window.frames) - 1)) for window in past]
            scores = self._client.score_episodes([*episodes, *before]) if episodes else []
        if self.options.reward == "success":
            return [_success(score) for score in scores]
        now = [score.progress for score in scores[: len(windows)]]
        if self.options.reward == "progress":
            return now
        earlier = {window.env: score.progress for window, score in zip(past, scores[len(windows) :], strict=True)}
        return [at - earlier.get(window.env, at) for window, at in zip(windows, now, strict=True)]

    def _episode(self, window: _Window, count: int) -> Episode:
        """Return an episode with the first pictures in a window."""
        episode = self._client.episode(window.task, env=window.env, **self.options.episode)
        for frame in window.frames[:count]:
            episode.keep(frame)
        return episode


def register() -> None:
    """Add the reward model to RLinf, as ``model_type: rfm``. RLinf calls this in each worker."""
    reward_model_registry[MODEL_TYPE] = RfmRewardModel


def _chosen(buffer: str | None, names: Sequence[str]) -> str | None:
    """Return which buffer to score; None: there is none."""
    if buffer is not None:
        return buffer
    require(f"{_WHERE}.buffer", len(names) <= 1, f"one of {', '.join(names)}", "none")
    return names[0] if names else None


def _num_envs(observations: Mapping[str, Any], pictures: Mapping[str, Any]) -> int:
    """Return how many environments there are. Raises InvalidSampleError if parts of the input disagree."""
    parts = {key: observations.get(key) for key in (TASKS, "dones")} | dict(pictures)
    counts = {key: len(values) for key, values in parts.items() if values is not None}
    expected = "as many environments in each part"
    require("observations", len(set(counts.values())) == 1, expected, counts or "none", InvalidSampleError)
    return next(iter(counts.values()))


def _image(picture: Any) -> UInt8Array:
    """Return a picture without the axis for a single view, [1, H, W, 3]."""
    array = as_array(picture)
    return array[0] if array.ndim == 4 and len(array) == 1 else array


def _success(score: StepScore) -> float:
    """Return the success probability. Raises InvalidSampleError if the checkpoint does not predict it."""
    expected = "progress or delta, since this checkpoint does not predict success"
    require(f"{_WHERE}.reward", not np.isnan(score.success), expected, "success", InvalidSampleError)
    return score.success


def _of(env: int) -> str:
    return f"envs[{env}]"


def _plain(node: Any) -> Any:
    """Return an OmegaConf node as dicts, lists and values."""
    if isinstance(node, Mapping):
        return {str(key): _plain(value) for key, value in node.items()}
    return [_plain(value) for value in node] if isinstance(node, Sequence) and not isinstance(node, str) else node
