# SPDX-License-Identifier: MIT
"""Gymnasium environments whose reward is a served reward model's. Needs ``pip install "./client[gym]"``.

env = gymnasium.make("CartPole-v1", render_mode="rgb_array")
env = RewardModelWrapper(env, partial(RewardClient, "grpc://localhost:8001"), "balance the pole")

All frames of the running episode are kept, H * W * 3 bytes a step: the rule ``sampling`` says which are shown.

Scored are the frame of the reset, every ``every``-th step, and the last step of an episode. With ``blocking`` a step
waits for its score. Without, it goes on with the newest answer that has come; with ``max_pending`` questions open
nothing is asked, and the step counts as skipped. Even then the frame of the reset is waited for, and the last step is,
unless ``await_last=False``; older questions are cancelled.

``info["reward_model"]``: ``progress`` and ``success`` (NaN: the checkpoint does not predict it) of the newest known
answer; the ``step`` that it is about, and its ``lag`` in steps; the steps ``skipped`` in this episode; after a step the
``env_reward``; with ``terminate_on_success`` whether the episode has ``succeeded``.

A RewardError comes out of ``reset`` or ``step`` and never becomes a reward. If the server failed, the frame is part of
the episode; in delta mode the next step pays what that one did not. If there was no frame to keep, the next ``step``
raises ResetNeeded. So does a step after an episode's end, unless the environment resets in that step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rfm_client.contract.errors import InvalidSampleError
from rfm_client.integrations.rewards import ClientSource, EpisodeRewarder, Info, RewardedEpisode, RewardOptions

try:
    import gymnasium
    from gymnasium.error import ResetNeeded
except ImportError as error:
    raise ImportError('rfm_client.gym needs gymnasium >= 1.1: pip install "./client[gym]"') from error

INFO = "reward_model"  # key of info

_ENDS = ("final_obs", "final_observation", "terminal_observation")  # what environments that reset in step add to info

DEFAULTS = RewardOptions()
LOST = "a frame was lost to the error of an earlier call"


class RewardModelWrapper(gymnasium.Wrapper):
    """An environment paid by a reward model; the module's docstring says how.

    client: a RewardClient, which stays open; or what makes one, at the first reset, which ``close()`` closes. For
        environments that are made in another process than they work in (AsyncVectorEnv) only the latter is right.
    task: the task sentence, or a function that reads it from the info of each reset

    A step after the episode's end raises ResetNeeded. If ``gymnasium.wrappers.Autoreset`` is among the wrappers of
    ``env``, the step after its end begins a new episode, and pays 0. ``env`` must not reset in the step of its end.

    Raises ValueError if frames cannot come from where ``options`` says, TypeError for what is no ``gymnasium.Env``.
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
        super().__init__(env)
        self._rewarder = EpisodeRewarder(client, options)
        self._options = options
        self._task = task
        self._autoresets: list[gymnasium.wrappers.Autoreset] = []  # among the wrappers of the environment
        while isinstance(env, gymnasium.Wrapper):
            if isinstance(env, gymnasium.wrappers.Autoreset):
                self._autoresets.append(env)
            env = env.env
        self._episode: RewardedEpisode | None = None
        self._is_whole = False  # all frames of the episode are kept
        self._has_ended = False

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Resets the environment and scores its first frame. Open requests are cancelled. Raises RewardError."""
        self._is_whole = False
        observation, info = self.env.reset(seed=seed, options=options)
        self._has_ended = False
        return observation, self._begin(observation, info)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Info]:
        """Steps the environment, with the reward model's reward. Raises RewardError, ResetNeeded."""
        resets = any(wrapper.autoreset for wrapper in self._autoresets)
        episode = None if resets else self._checked_episode()
        self._is_whole = False  # until the frame is kept
        observation, env_reward, terminated, truncated, info = self.env.step(action)
        self._has_ended = bool(terminated or truncated)
        if episode is None:
            return observation, 0.0, terminated, truncated, self._begin(observation, info)
        if self._has_ended:
            _check_shows_its_end(info)
        episode.add(self._frame(observation))
        self._is_whole = True
        self._rewarder.score({episode: self._has_ended})
        reward = episode.reward(float(env_reward))
        scores = {**episode.info(), "env_reward": float(env_reward)}
        return observation, reward, bool(terminated or episode.succeeded), truncated, {**info, INFO: scores}

    def close(self) -> None:
        """Cancels what is open, and closes the environment, and the client if it was made here."""
        if self._episode is not None:
            self._episode.end()
        self._rewarder.close()
        super().close()

    def _begin(self, observation: Any, info: Info) -> Info:
        """A new episode, whose first frame this is; its scores beside the info."""
        if self._episode is not None:
            self._episode.end()
        task = self._task if isinstance(self._task, str) else self._task(info)
        self._episode = self._rewarder.begin(task, self._frame(observation))
        self._is_whole = True
        self._rewarder.score({self._episode: False})
        return {**info, INFO: self._episode.info()}

    def _checked_episode(self) -> RewardedEpisode:
        """The episode whose next frame the next step shows. Raises ResetNeeded if there is none."""
        if self._episode is None:
            raise ResetNeeded("step: expected a reset before it")
        if self._has_ended or self._episode.succeeded:
            remedy = "call reset, or wrap the environment in gymnasium.wrappers.Autoreset before RewardModelWrapper"
            raise ResetNeeded(f"step: expected a reset, since the episode has ended, got another step; {remedy}")
        if not self._is_whole:
            raise ResetNeeded(f"step: expected a reset, since {LOST}, got another step; call reset")
        return self._episode

    def _frame(self, observation: Any) -> Any:
        return self.env.render() if self._options.renders else self._options.frames_of(observation)


def check_kind(env: Any, kind: type[Any]) -> None:
    """Raises TypeError for another kind of environment."""
    if not isinstance(env, kind):
        got = f"{type(env).__module__}.{type(env).__name__}"
        remedy = "wrap each environment in RewardModelWrapper before you make another kind of vector of them"
        raise TypeError(f"env: expected a gymnasium {kind.__name__}, got {got}; {remedy}")


def _check_shows_its_end(info: Info) -> None:
    """Raises InvalidSampleError for an environment that already shows its next episode."""
    found = [key for key in _ENDS if key in info]
    if found:
        expected = f"none of {', '.join(_ENDS)} from an environment that shows the last frame of its episode"
        remedy = "let it not reset in step, and wrap it in gymnasium.wrappers.Autoreset if resets shall be automatic"
        raise InvalidSampleError.at("info", expected, f"{', '.join(found)}; {remedy}")


def check_frame_source(options: RewardOptions, render_mode: str | None, space: gymnasium.Space[Any]) -> None:
    """Raises ValueError if frames cannot come from where the options say."""
    if options.renders and render_mode != "rgb_array":
        expected = "'rgb_array', since frames come from render() unless frames_from or cameras say otherwise"
        raise ValueError(f"render_mode: expected {expected}, got {render_mode!r}")
    keys = list(space.keys()) if isinstance(space, gymnasium.spaces.Dict) else []
    if isinstance(options.frames_from, str) and options.frames_from not in keys:
        raise ValueError(f"frames_from: expected a key of the observation {keys}, got {options.frames_from!r}")
    if options.frames_from is None and not set(options.cameras) <= set(keys):
        raise ValueError(f"cameras: expected keys of the observation {keys}, got {list(options.cameras)}")
