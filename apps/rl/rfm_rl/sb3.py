# SPDX-License-Identifier: MIT
"""Stable-Baselines3 vectors with rewards from a served reward model. Needs ``./apps/rl[sb3]``.

envs = make_vec_env("CartPole-v1", 8, env_kwargs={"render_mode": "rgb_array"}, wrapper_class=RenderedFrame)
envs = RewardModelVecEnv(envs, partial(RewardClient, "grpc://localhost:8001"), "balance the pole")

``gym.py`` states the rules. A ``VecEnv`` resets an environment in the step that ends its episode. That episode's last
frame is then in the info: ``terminal_observation``, or the frame from RenderedFrame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import Any

import gymnasium
import numpy as np

from rfm_client import InvalidSampleError
from rfm_client.options import require
from rfm_rl.envs import INFO, ClientSource, RewardedEnvs
from rfm_rl.gym import DEFAULTS, check_frame_source, tasks_of
from rfm_rl.own_resets import HAS_RESET, CopiedObservation, check_renders_its_end, copied_steps, watched_resets
from rfm_rl.rewards import RELABELS, Info, RewardOptions, refuse_relabelling, with_statistics

try:
    from stable_baselines3.common.vec_env import (
        DummyVecEnv,
        SubprocVecEnv,
        VecEnv,
        VecEnvWrapper,
        unwrap_vec_normalize,
    )
except ImportError as error:
    raise ImportError('rfm_rl.sb3 needs stable-baselines3: pip install ./client "./apps/rl[sb3]"') from error

__all__ = ["RenderedFrame", "RewardModelVecEnv", "RewardOptions"]

_FRAME = "rendered_frame"  # key in the infos from RenderedFrame
_RENDERED = "make_vec_env(..., wrapper_class=RenderedFrame)"


class RenderedFrame(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment that renders at each step, for a RewardModelVecEnv around its ``VecEnv``.

    The picture is part of the info, because the ``VecEnv`` resets before it returns.
    """

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Reset the environment, and add a picture to the info."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, {**info, _FRAME: np.array(self.env.render())}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, Info]:
        """Step the environment, and add a picture to the info, unless the environment has reset after its last."""
        with watched_resets(self.env) as own_resets:
            observation, reward, terminated, truncated, info = self.env.step(action)
        if not (own_resets and (terminated or truncated)):
            info = {**info, _FRAME: np.array(self.env.render())}
        return observation, reward, terminated, truncated, info


class RewardModelVecEnv(VecEnvWrapper):  # type: ignore[misc]  # its package is optional, and so untyped here
    """A ``VecEnv`` with a reward model's rewards. With ``blocking``, a step scores all environments in one call.

    client: as in RewardModelWrapper
    task: one task sentence for all environments, or a sequence with one for each

    ``infos[i]["reward_model"]`` is as in RewardModelWrapper. ``reset_infos`` has the same for each reset.

    Raises ValueError if ``options`` names a frame source that ``venv`` lacks; for frames from ``render()`` unless
    each environment is wrapped in RenderedFrame; and for ``terminate_on_success``, because an environment that resets
    by itself does not know about the success: wrap each environment in RewardModelWrapper instead. Raises ValueError
    for a ``VecNormalize`` inside: off-policy algorithms would store the rewards that it got. Raises TypeError if
    ``venv`` is not a ``VecEnv``.
    """

    def __init__(
        self,
        venv: Any,
        client: ClientSource,
        task: str | Sequence[str],
        options: RewardOptions = DEFAULTS,
    ) -> None:
        if not isinstance(venv, VecEnv):
            got = f"{type(venv).__module__}.{type(venv).__name__}"
            remedy = "rfm_rl has wrappers of gymnasium's environments and vectors"
            raise TypeError(f"venv: expected a VecEnv of stable_baselines3, got {got}; {remedy}")
        check_frame_source(options, venv.render_mode, venv.observation_space)
        is_rendered = not options.renders or all(venv.env_is_wrapped(RenderedFrame))
        require(
            "venv", is_rendered, "each environment in RenderedFrame, for frames from render()", f"none: {_RENDERED}"
        )
        instead = f"{options.terminate_on_success}; wrap each environment in RewardModelWrapper instead"
        require("terminate_on_success", options.terminate_on_success is None, "None, since a VecEnv resets", instead)
        expected = "no VecNormalize inside, whose rewards SAC and other off-policy algorithms would learn from"
        instead = "one; wrap in the other order: VecNormalize(RewardModelVecEnv(...))"
        require("venv", unwrap_vec_normalize(venv) is None, expected, instead)
        tasks = tasks_of(task, venv.num_envs)
        final = "infos[{}]['terminal_observation']"
        is_here = isinstance(venv.unwrapped, DummyVecEnv) and not options.renders
        self._here = list(venv.unwrapped.envs) if is_here else []  # environments in this process
        may_look = isinstance(venv.unwrapped, (DummyVecEnv, SubprocVecEnv))
        in_processes = may_look and all(venv.env_is_wrapped(CopiedObservation))
        copies = options.renders or is_here or in_processes
        self._envs = RewardedEnvs(client, options, tasks, remedy="call reset", final=final, returns_copies=copies)
        self._reward_options = options
        super().__init__(venv)  # which reads attributes

    def reset(self) -> Any:
        """Reset the environments and score their first frames. Cancel open requests. Raises RewardError."""
        self._envs.check_reset(np.ones(self.num_envs, np.bool_))
        observations = self.venv.reset()
        self._take_reset_infos(range(self.num_envs))
        self._envs.begin(lambda index: self._first(index, observations))
        self._tell_resets(range(self.num_envs))
        return observations

    def step_async(self, actions: Any) -> None:
        """Begin a step. Raises ResetNeeded before a reset, and after a step whose frames were lost; RewardError."""
        self._envs.check_step(np.zeros(self.num_envs, np.bool_))
        self.venv.step_async(actions)

    def step_wait(self) -> tuple[Any, Any, Any, list[Info]]:
        """End the step; return the model's rewards, float32 [num_envs]. Raises RewardError."""
        with ExitStack() as stack:
            for env in self._here:
                stack.enter_context(copied_steps(env))
            observations, env_rewards, dones, step_infos = self.venv.step_wait()
        infos = [dict(info) for info in step_infos]  # a list in one ``VecEnv``, a tuple in another
        ended = np.flatnonzero(dones).tolist()
        for index in ended:
            has_reset = _FRAME not in infos[index] or HAS_RESET in infos[index]
            check_renders_its_end(self._reward_options, f"infos[{index}]", has_reset)
        self._take_reset_infos(ended)
        rendered = [info.pop(_FRAME, None) for info in infos]
        truncated = dones & np.array([info.get("TimeLimit.truncated", False) for info in infos], np.bool_)

        is_rendered = self._reward_options.renders

        def shown(index: int) -> Any:
            return rendered[index] if is_rendered and not dones[index] else self._first(index, observations)

        def final(index: int) -> Any:
            return rendered[index] if is_rendered else self._final_frame(index, infos[index])

        rewards, stepped = self._envs.keep(shown, env_rewards, dones & ~truncated, truncated, final=final)
        for index, episode in stepped.items():
            infos[index] = {**with_statistics(infos[index], episode), INFO: episode.info()}
        self._tell_resets(ended)
        return observations, rewards.astype(np.float32), dones, infos

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Call a method on the environments. Raises NotImplementedError for ``compute_reward``, which HER calls."""
        if method_name == RELABELS:
            refuse_relabelling()
        results: list[Any] = self.venv.env_method(method_name, *args, indices=indices, **kwargs)
        return results

    def close(self) -> None:
        """Cancel open requests; close the environments, and the client if it was made here."""
        self._envs.close()
        self.venv.close()

    def _first(self, index: int, observations: Any) -> Any:
        """Return the first frame in an environment's new episode."""
        if not self._reward_options.renders:
            return self._reward_options.frames_of(_of_env(observations, index))
        frame = self.reset_infos[index].pop(_FRAME, None)
        where = f"reset_infos[{index}]"
        require(where, frame is not None, "the frame of RenderedFrame", "none", InvalidSampleError)
        return frame

    def _take_reset_infos(self, indices: Sequence[int]) -> None:
        for index in indices:
            self.reset_infos[index] = dict(self.venv.unwrapped.reset_infos[index])

    def _tell_resets(self, indices: Sequence[int]) -> None:
        for index in indices:
            self.reset_infos[index] |= {INFO: self._envs.episodes[index].info()}

    def _final_frame(self, index: int, info: Mapping[str, Any]) -> Any:
        where, expected = f"infos[{index}]", "the terminal_observation of the episode that ended in this step"
        require(where, "terminal_observation" in info, expected, f"none in {list(info)}", InvalidSampleError)
        return self._reward_options.frames_of(info["terminal_observation"])


def _of_env(observations: Any, index: int) -> Any:
    """Return one environment's observation from a ``VecEnv``'s: arrays [num_envs, ...], or a dict or tuple of them."""
    if isinstance(observations, Mapping):
        return {key: value[index] for key, value in observations.items()}
    if isinstance(observations, tuple):
        return tuple(value[index] for value in observations)
    return observations[index]
