# SPDX-License-Identifier: MIT
"""Gymnasium environments with rewards from a served reward model.

env = gymnasium.make("CartPole-v1", render_mode="rgb_array")
env = RewardModelWrapper(env, partial(RewardClient, "grpc://localhost:8001"), "balance the pole")

A wrapper keeps all frames of the running episode, H * W * 3 bytes per step. The rule ``sampling`` selects from them.

A wrapper scores the reset, every ``every``-th step (not in mode ``final`` without a success rule), and the last step of
an episode. With ``blocking``, a step waits for its score. Without ``blocking``, a step uses the newest known score, and
requests its own only if fewer than ``max_pending`` steps have open requests. The reset always waits for its score. The
last step waits, too, and cancels older requests.

``info["reward_model"]`` has the same keys after a reset and after a step: the returned ``reward`` and the environment's
own ``env_reward`` (NaN at a reset), ``progress`` and ``success`` from the newest known score (success is NaN if the
checkpoint does not predict it), its ``step``, its ``lag`` in steps, the steps ``skipped`` in this episode, and the
other scores that the checkpoint gives by default (``StepScore.more_scores``). With ``terminate_on_success`` or
``success_bonus`` there is also ``succeeded``.

``reset`` and ``step`` raise RewardError; an error never becomes a reward. If the server failed, the episode keeps the
frame, and in delta mode the next reward includes its change; a step after such a reset first scores the reset's frame.
If the frame was lost, the next ``step`` raises ResetNeeded. A step after an episode's end does, too, unless the
environment resets in that step.

``compute_reward`` of RewardModelWrapper raises NotImplementedError: hindsight relabelling would mix the environment's
rewards with the model's. With a Monitor or RecordEpisodeStatistics inside a wrapper, ``info["episode"]`` has the
model's summed rewards. These wrappers do not see an end by ``terminate_on_success``, so RewardModelWrapper adds the
sum there.

A time limit belongs inside the wrapper, as ``gymnasium.make`` puts it. If a reset drops the reward of an unended
episode, a warning is logged once. In mode ``final``, a second such reset in a row, with no episode end and no error in
between, raises ValueError.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import gymnasium
import numpy as np

from rfm_client.options import InvalidValueError, require
from rfm_rl.envs import INFO, ClientSource, RewardedEnvs
from rfm_rl.own_resets import HAS_RESET, check_observes_its_end, check_renders_its_end, watched_resets
from rfm_rl.rewards import RETURNS, Info, RewardOptions, refuse_relabelling, with_statistics

DEFAULTS = RewardOptions()
_ALL = np.ones(1, np.bool_)
_REMEDY = "call reset, or wrap the RewardModelWrapper in gymnasium.wrappers.Autoreset"
_UNBATCH = (
    "ManiSkill: RewardModelVectorWrapper(ManiSkillVectorEnv(env), ...), or CPUGymWrapper(env) if there is one; "
    "Isaac Lab never shows an episode's last frame: score its frames with client.score_episodes(episodes)"
)


class RewardModelWrapper(gymnasium.Wrapper):
    """An environment with a reward model's rewards, by the rules in the module's docstring.

    client: a RewardClient, which stays open; or a function that makes a client at the first reset, which ``close()``
        closes. Pass a function if the environment will run in another process (AsyncVectorEnv)
    task: the task sentence, or a function that reads it from the info at each reset

    A step after an episode's end raises ResetNeeded. With ``Autoreset(RewardModelWrapper(env, ...))`` from
    ``gymnasium.wrappers``, this step begins a new episode instead, with reward 0. If ``env`` itself resets in the step
    that ends an episode, that step raises InvalidSampleError, unless frames come from an observation before the reset.

    Raises ValueError if ``options`` names a frame source that ``env`` lacks, and for an ``Autoreset`` among the
    wrappers around ``env``; TypeError if ``env`` is not a ``gymnasium.Env``.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        client: ClientSource,
        task: str | Callable[[Info], str],
        options: RewardOptions = DEFAULTS,
    ) -> None:
        check_kind(env, gymnasium.Env)
        check_frame_source(options, env.render_mode, env.observation_space)
        resets = any(isinstance(layer, gymnasium.wrappers.Autoreset) for layer in _layers(env))
        require(
            "env", not resets, "no Autoreset inside", "one; wrap in the other order: Autoreset(RewardModelWrapper(...))"
        )
        is_task = isinstance(task, str) or callable(task)
        require("task", is_task, "a task sentence, or a function from a reset's info to it", repr(task))
        super().__init__(env)
        self._envs = RewardedEnvs(client, options, [""], remedy=_REMEDY, is_only=True)
        self._options = options
        self._task = task
        self._has_statistics = env.has_wrapper_attr(RETURNS)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Reset the environment and score its first frame. Cancel open requests. Raises RewardError, ValueError."""
        self._envs.check_reset(_ALL)
        observation, info = self.env.reset(seed=seed, options=options)
        self._envs.tasks[0] = self._task if isinstance(self._task, str) else self._task(info)
        self._envs.begin(lambda _: self._frame(observation))
        return observation, {**info, INFO: self._envs.episodes[0].info()}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Info]:
        """Step the environment; return the reward model's reward. Raises RewardError, ResetNeeded."""
        self._envs.check_step(~_ALL)
        with watched_resets(self.env) as own_resets:
            observation, env_reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            check_observes_its_end(info)
            check_renders_its_end(self._options, "info", bool(own_resets) or HAS_RESET in info)
        results = [float(env_reward)], [bool(terminated)], [bool(truncated)]
        (reward,), _ = self._envs.keep(lambda _: self._frame(observation), *results)
        episode = self._envs.episodes[0]
        info = {**with_statistics(info, episode, has_statistics=self._has_statistics), INFO: episode.info()}
        return observation, float(reward), bool(terminated or episode.succeeded), truncated, info

    compute_reward = refuse_relabelling

    def close(self) -> None:
        """Cancel open requests; close the environment, and the client if it was made here."""
        self._envs.close()
        super().close()

    def _frame(self, observation: Any) -> Any:
        return self.env.render() if self._options.renders else self._options.frames_of(observation)


def check_kind(env: Any, kind: type[Any]) -> None:
    """Raise TypeError for another kind of environment, and for an ``Env`` that is a batch of environments."""
    is_batch = isinstance(env, gymnasium.Env) and _is_batch(env)
    if is_batch or not isinstance(env, kind):
        of = env.unwrapped if is_batch else env
        got = f"{type(of).__module__}.{type(of).__name__}"
        remedy = "for a gymnasium vector use RewardModelVectorWrapper; else wrap each environment in RewardModelWrapper"
        if is_batch:
            got, remedy = f"an Env that is a batch of environments, {got}", _UNBATCH
        raise TypeError(f"env: expected a gymnasium {kind.__name__}, got {got}; {remedy}")


def _layers(env: gymnasium.Env[Any, Any]) -> Iterator[gymnasium.Env[Any, Any]]:
    """Yield the environment, and those inside its wrappers."""
    yield env
    while isinstance(env, gymnasium.Wrapper):
        env = env.env
        yield env


def _is_batch(env: gymnasium.Env[Any, Any]) -> bool:
    """True for a ManiSkill or Isaac Lab environment, unless a wrapper picks the only environment in the batch."""
    single = getattr(env.unwrapped, "single_observation_space", None)
    return single is not None and all(layer.observation_space != single for layer in _layers(env))


def tasks_of(task: str | Sequence[str], num_envs: int) -> list[str]:
    """Return a task sentence for each environment in a vector. Raises ValueError for another number of sentences."""
    require("task", isinstance(task, Iterable), "a task sentence, or one for each environment", repr(task))
    tasks = [task] * num_envs if isinstance(task, str) else list(task)
    require("task", len(tasks) == num_envs, f"one for each of the {num_envs} environments", len(tasks))
    return tasks


def check_frame_source(options: RewardOptions, render_mode: str | None, space: gymnasium.Space[Any]) -> None:
    """Raise ValueError if the options name a frame source that the environment lacks."""
    if options.renders and render_mode != "rgb_array":
        expected = "'rgb_array', since frames come from render() unless frames_from or cameras say otherwise"
        raise InvalidValueError.at("render_mode", expected, repr(render_mode))
    keys = list(space.keys()) if isinstance(space, gymnasium.spaces.Dict) else []
    source, cameras = options.frames_from, list(options.cameras)
    is_key = not isinstance(source, str) or source in keys
    require("frames_from", is_key, f"a key of the observation {keys}", repr(source))
    are_keys = source is not None or set(cameras) <= set(keys)
    require("cameras", are_keys, f"keys of the observation {keys}", cameras)
