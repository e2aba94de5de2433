# SPDX-License-Identifier: MIT
"""Gymnasium environments whose reward is a served reward model's. Needs ``pip install "./client[gym]"``.

env = gymnasium.make("CartPole-v1", render_mode="rgb_array")
env = RewardModelWrapper(env, partial(RewardClient, "grpc://localhost:8001"), "balance the pole")

Frames: each step's frame is kept until the next reset, and so is that of the reset: H * W * 3 bytes a step. All are
needed: the rule ``sampling`` says which are sent, and which ones moves as episodes grow.

Scored are the frame of the reset, every ``every``-th step, and the last step of an episode. With ``blocking`` a step
waits for its score. Without, it sends its frames and goes on with the newest answer that has come; an answer older
than the one in use is ignored; with ``max_pending`` questions open nothing is sent, and the step counts as skipped.
Even then the frame of the reset is waited for, so that there is a score from the start, and the last step is, unless
``await_last=False``; older questions are needless then, and cancelled.

``info["reward_model"]``: ``progress`` and ``success`` (NaN: the checkpoint does not predict it) of the newest known
answer; the ``step`` of the episode that it is about, and its ``lag`` in steps; the steps ``skipped`` in this episode;
after a step the ``env_reward``; with ``terminate_on_success`` whether the episode has ``succeeded``.

A RewardError is raised out of ``reset`` or ``step`` and never becomes a reward. In delta mode the next step pays what
that one did not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client.contract.errors import InvalidSampleError
from rfm_client.episodes.options import SuccessRule
from rfm_client.integrations.episode import ClientSource, Episode, Info, RewardOptions, Scorer

try:
    import gymnasium
    from gymnasium.error import ResetNeeded
    from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
    from gymnasium.vector.utils import iterate
except ImportError as error:
    raise ImportError('rfm_client.gym needs gymnasium >= 1.1: pip install "./client[gym]"') from error

INFO = "reward_model"  # key of info

__all__ = ["RewardModelVectorWrapper", "RewardModelWrapper", "RewardOptions", "SuccessRule"]

_DEFAULTS = RewardOptions()


class RewardModelWrapper(gymnasium.Wrapper):
    """An environment paid by a reward model; the module's docstring says how.

    client: a RewardClient, which stays open; or what makes one, at the first reset, which ``close()`` closes. For
        environments that are made in another process than they work in (AsyncVectorEnv) only the latter is right.
    task: the task sentence, or a function that reads it from the info of each reset

    Raises ValueError if frames cannot come from where ``options`` says.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        client: ClientSource,
        task: str | Callable[[Info], str],
        options: RewardOptions = _DEFAULTS,
    ) -> None:
        _check_frame_source(options, env.render_mode, env.observation_space)
        super().__init__(env)
        self._scorer = Scorer(client, options)
        self._options = options
        self._task = task
        self._episode: Episode | None = None

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Resets the environment and scores its first frame. Open requests are cancelled. Raises RewardError."""
        observation, info = self.env.reset(seed=seed, options=options)
        if self._episode is not None:
            self._episode.end()
        task = self._task if isinstance(self._task, str) else self._task(info)
        self._episode = Episode(self._options, task)
        self._episode.add(self._frame(observation), self._scorer.fit)
        self._scorer.score({self._episode: False})
        return observation, {**info, INFO: self._episode.info()}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Info]:
        """Steps the environment, with the reward model's reward. Raises RewardError."""
        observation, env_reward, terminated, truncated, info = self.env.step(action)
        if self._episode is None:
            raise ResetNeeded("step: expected a reset before it")
        self._episode.add(self._frame(observation), self._scorer.fit)
        self._scorer.score({self._episode: terminated or truncated})
        reward = self._episode.reward(float(env_reward))
        scores = {**self._episode.info(), "env_reward": float(env_reward)}
        return observation, reward, bool(terminated or self._episode.succeeded), truncated, {**info, INFO: scores}

    def close(self) -> None:
        """Cancels what is open, and closes the environment, and the client if it was made here."""
        if self._episode is not None:
            self._episode.end()
        self._scorer.close()
        super().close()

    def _frame(self, observation: Any) -> Any:
        return self.env.render() if self._options.renders else self._options.frames_of(observation)


class RewardModelVectorWrapper(VectorWrapper):
    """A vector environment paid by a reward model: its sub-environments' questions of a step go in one call.

    client: as in RewardModelWrapper
    task: one task sentence for all sub-environments, or one for each

    ``infos["reward_model"]`` has arrays and masks as Gymnasium's own infos; where a sub-environment resets in the step
    that ends its episode (SAME_STEP), the end's is in ``infos["final_info"]``. The step in which one does nothing but
    reset (NEXT_STEP) is paid 0, as in Gymnasium, and waits for the score of that frame even when not blocking.

    Raises ValueError if frames cannot come from where ``options`` says, for SAME_STEP with frames from ``render()``,
    which never shows an episode's last frame, and for ``terminate_on_success`` unless the mode is DISABLED: what
    resets by itself does not know of it. Wrap each sub-environment in RewardModelWrapper then.
    """

    def __init__(
        self,
        env: VectorEnv,
        client: ClientSource,
        task: str | Sequence[str],
        options: RewardOptions = _DEFAULTS,
    ) -> None:
        _check_frame_source(options, env.render_mode, env.single_observation_space)
        autoreset_mode = _checked_autoreset_mode(env, options)
        tasks = [task] * env.num_envs if isinstance(task, str) else list(task)
        if len(tasks) != env.num_envs:
            raise ValueError(f"task: expected one for each of the {env.num_envs} environments, got {len(tasks)}")
        super().__init__(env)  # a wrapper that is refused must not close the environments when it is collected
        self._scorer = Scorer(client, options)
        self._options = options
        self._autoreset_mode = autoreset_mode
        self._tasks = tasks
        self._episodes: dict[int, Episode] = {}
        self._ended: npt.NDArray[np.bool_] = np.zeros(env.num_envs, np.bool_)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Resets the environments (those of ``reset_mask``), and scores their first frames. Raises RewardError."""
        everyone = np.ones(self.num_envs, np.bool_)
        reset_mask = (options or {}).get("reset_mask", everyone)  # before env.reset, which takes it out of the options
        observations, infos = self.env.reset(seed=seed, options=options)
        frames = self._frames(observations)
        self._ended = self._ended & ~reset_mask
        indices = np.flatnonzero(reset_mask).tolist()
        for episode in [self._episodes[index] for index in indices if index in self._episodes]:
            episode.end()
        fresh = {index: self._begin(index, frames[index]) for index in indices}
        self._scorer.score(dict.fromkeys(fresh.values(), False))
        return observations, self._with_scores(infos, fresh)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, Info]:
        """Steps the environments, with the reward model's rewards, float64 [num_envs]. Raises RewardError."""
        observations, env_rewards, terminations, truncations, infos = self.env.step(actions)
        if len(self._episodes) != self.num_envs:
            raise ResetNeeded("step: expected a reset of every environment before it")
        frames = self._frames(observations)
        ended = terminations | truncations
        final = self._final_frames(infos, ended) if self._autoreset_mode is AutoresetMode.SAME_STEP else {}
        reset_alone = self._ended if self._autoreset_mode is AutoresetMode.NEXT_STEP else np.zeros_like(ended)
        stepped = {index: self._episodes[index] for index in np.flatnonzero(~reset_alone).tolist()}
        for index, episode in stepped.items():
            episode.add(final.get(index, frames[index]), self._scorer.fit)
        fresh = {index: self._begin(index, frames[index]) for index in (*np.flatnonzero(reset_alone).tolist(), *final)}
        self._ended = ended
        self._scorer.score(
            {episode: bool(ended[index]) for index, episode in stepped.items()} | dict.fromkeys(fresh.values(), False)
        )
        rewards = np.zeros(self.num_envs)
        for index, episode in stepped.items():
            rewards[index] = episode.reward(float(env_rewards[index]))
            scores: Info = {INFO: episode.info() | {"env_reward": float(env_rewards[index])}}
            infos = self._add_info(infos, {"final_info": scores} if index in final else scores, index)
        succeeded = np.array([episode.succeeded for _, episode in sorted(self._episodes.items())])
        return observations, rewards, terminations | succeeded, truncations, self._with_scores(infos, fresh)

    def close(self, **kwargs: Any) -> None:
        """Cancels what is open, and closes the environments, and the client if it was made here."""
        for episode in self._episodes.values():
            episode.end()
        self._scorer.close()
        super().close(**kwargs)

    def _begin(self, index: int, frame: Any) -> Episode:
        self._episodes[index] = Episode(self._options, self._tasks[index], index)
        self._episodes[index].add(frame, self._scorer.fit)
        return self._episodes[index]

    def _frames(self, observations: Any) -> Sequence[Any]:
        """The frame of each environment."""
        if self._options.renders:
            frames = list(self.env.render() or ())
        else:
            frames = [self._options.frames_of(each) for each in iterate(self.env.observation_space, observations)]
        if len(frames) != self.num_envs:
            raise InvalidSampleError.at("frames", f"one of each of the {self.num_envs} environments", str(len(frames)))
        return frames

    def _final_frames(self, infos: Info, ended: npt.NDArray[np.bool_]) -> dict[int, Any]:
        """The last frames of the episodes that ended, whose environments show the next episode already."""
        indices = np.flatnonzero(ended).tolist()
        if indices and "final_obs" not in infos:
            raise InvalidSampleError.at("infos", "final_obs of the environments that were reset", str(list(infos)))
        return {index: self._options.frames_of(infos["final_obs"][index]) for index in indices}

    def _with_scores(self, infos: Info, fresh: Mapping[int, Episode]) -> Info:
        for index, episode in fresh.items():
            infos = self._add_info(infos, {INFO: episode.info()}, index)
        return infos


def _check_frame_source(options: RewardOptions, render_mode: str | None, space: gymnasium.Space[Any]) -> None:
    if options.renders and render_mode != "rgb_array":
        expected = "'rgb_array', since frames come from render() unless frames_from or cameras say otherwise"
        raise ValueError(f"render_mode: expected {expected}, got {render_mode!r}")
    keys = list(space.keys()) if isinstance(space, gymnasium.spaces.Dict) else []
    if isinstance(options.frames_from, str) and options.frames_from not in keys:
        raise ValueError(f"frames_from: expected a key of the observation {keys}, got {options.frames_from!r}")
    if options.frames_from is None and not set(options.cameras) <= set(keys):
        raise ValueError(f"cameras: expected keys of the observation {keys}, got {list(options.cameras)}")


def _checked_autoreset_mode(env: VectorEnv, options: RewardOptions) -> AutoresetMode:
    mode = env.metadata.get("autoreset_mode")
    instead = "; wrap each environment in RewardModelWrapper instead"
    if not isinstance(mode, AutoresetMode):
        raise ValueError(f"metadata['autoreset_mode']: expected an AutoresetMode, got {mode!r}")
    if mode is AutoresetMode.SAME_STEP and options.renders:
        expected = "NEXT_STEP or DISABLED with frames from render(), which never shows an episode's last frame"
        raise ValueError(f"autoreset_mode: expected {expected}, got SAME_STEP{instead}")
    if mode is not AutoresetMode.DISABLED and options.terminate_on_success is not None:
        raise ValueError(f"autoreset_mode: expected DISABLED with terminate_on_success, got {mode.name}{instead}")
    return mode
