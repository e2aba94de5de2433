# SPDX-License-Identifier: MIT
"""Gymnasium vector environments with rewards from a served reward model. ``gym.py`` states the rules.

A vector may return torch tensors on a GPU, as ManiSkillVectorEnv does. Nothing here imports torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.vector.utils import iterate

from rfm_client import InvalidSampleError, as_array
from rfm_client.options import InvalidValueError, require
from rfm_rl.envs import INFO, ClientSource, Mask, RewardedEnvs
from rfm_rl.gym import DEFAULTS, check_frame_source, check_kind, tasks_of
from rfm_rl.own_resets import HAS_RESET, check_renders_its_end, copied_steps, watched_resets
from rfm_rl.rewards import Info, RewardOptions, correct_statistics

_INSTEAD_OF_SAME_STEP = "make the vector with autoreset_mode=AutoresetMode.NEXT_STEP"
_REMEDY = 'call reset, for some environments with options={"reset_mask": mask}'
_MANI_SKILL_MASK = "env_idx"  # ManiSkill's key in reset options
_RESET_MASK = "reset_mask"  # key in reset options, which Gymnasium's vectors remove


class RewardModelVectorWrapper(VectorWrapper):
    """A vector environment with a reward model's rewards.

    With ``blocking``, a step scores all sub-environments in one call.

    client: as in RewardModelWrapper
    task: one task sentence for all sub-environments, or a sequence with one for each

    Rewards are float64 [num_envs]. If ``env`` returns tensors, they are a float32 tensor on its device; terminations
    are a tensor, too. ``infos["reward_model"]`` has arrays and masks, like Gymnasium's own infos. The autoreset mode
    matters:

    - SAME_STEP: the last scores of an ended episode are in ``infos["final_info"]``.
    - NEXT_STEP: a step that only resets a sub-environment has reward 0, as in Gymnasium. The step waits for that
      frame's score even when not blocking.
    - DISABLED: a step after an episode's end raises ResetNeeded.

    Raises ValueError if ``options`` names a frame source that ``env`` lacks; for SAME_STEP with frames from
    ``render()``, which never shows an episode's last frame; and for ``terminate_on_success`` unless DISABLED, because
    an environment that resets by itself does not know about the success. In the last two cases, wrap each
    sub-environment in RewardModelWrapper instead. Raises TypeError if ``env`` is not a ``gymnasium.vector.VectorEnv``.
    """

    def __init__(
        self,
        env: VectorEnv,
        client: ClientSource,
        task: str | Sequence[str],
        options: RewardOptions = DEFAULTS,
    ) -> None:
        check_kind(env, VectorEnv)
        check_frame_source(options, env.render_mode, env.single_observation_space)
        _check_tells_resets(env, options)
        autoreset_mode = _checked_autoreset_mode(env, options)
        tasks = tasks_of(task, env.num_envs)
        super().__init__(env)  # after the checks: a refused wrapper must not close the environments when collected
        here = list(env.unwrapped.envs) if isinstance(env.unwrapped, SyncVectorEnv) else []
        is_mani_skill = type(env).__module__.startswith("mani_skill.")  # which keeps copies of last frames
        in_processes = _of_each(env, "has_wrapper_attr", "copies_observations")
        has_copies = bool(here) or is_mani_skill or (bool(in_processes) and all(in_processes))
        self._envs = RewardedEnvs(
            client, options, tasks, remedy=_REMEDY, final="final_obs[{}]", returns_copies=has_copies
        )
        self._options = options
        self._autoreset_mode = autoreset_mode
        self._here = here if options.renders or autoreset_mode is AutoresetMode.SAME_STEP else []  # in this process

    @property
    def autoreset_mode(self) -> AutoresetMode:
        """The vector's autoreset mode, as TorchRL reads it."""
        return self._autoreset_mode

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Reset the environments, or those in ``reset_mask``, and score their first frames.

        options: passed on; ``reset_mask`` may be an array, a list or a tensor, bool [num_envs]

        Raises RewardError; ValueError for a wrong mask, a vector that does not read it, and as RewardModelWrapper.
        """
        reset_mask, options = self._masked(options)
        self._check_can_reset(self._resetting & reset_mask)
        self._envs.check_reset(reset_mask)
        observations, infos = self.env.reset(seed=seed, options=options)
        self._check_was_masked(options)
        self._envs.begin(partial(self._frame, self._shown(observations)))
        return observations, self._with_scores(infos, reset_mask)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, Info]:
        """Step the environments; return the model's rewards, [num_envs]. Raises RewardError, ResetNeeded."""
        resetting = self._resetting
        self._envs.check_step(resetting)
        with ExitStack() as stack:
            watch = watched_resets if self._options.renders else copied_steps
            watched = [stack.enter_context(watch(env)) for env in self._here]
            observations, env_rewards, terminations, truncations, infos = self.env.step(actions)
        terminated, truncated = (as_array(each).astype(np.bool_) for each in (terminations, truncations))
        ended, resets_at_once = terminated | truncated, self._autoreset_mode is AutoresetMode.SAME_STEP
        have_reset = as_array(infos.get(f"_{HAS_RESET}", False)) | ([bool(resets) for resets in watched] or False)
        for index in np.flatnonzero(ended & have_reset).tolist():
            check_renders_its_end(self._options, f"infos[{index}]", True)
        final = partial(self._frame, self._final_observations(infos, ended)) if resets_at_once else None
        shown = partial(self._frame, self._shown(observations))
        rewards, stepped = self._envs.keep(shown, as_array(env_rewards), terminated, truncated, final=final)
        for index, episode in stepped.items():
            correct_statistics(infos, index, episode)
            scores: Info = {INFO: episode.info()}
            has_reset = resets_at_once and ended[index]
            infos = self._add_info(infos, {"final_info": scores} if has_reset else scores, index)
        infos = self._with_scores(infos, resetting | (ended & resets_at_once))
        terminated = terminated | self._envs.succeeded
        return observations, _like(env_rewards, rewards), _like(terminations, terminated), truncations, infos

    def close(self, **kwargs: Any) -> None:
        """Cancel open requests; close the environments, and the client if it was made here."""
        self._envs.close()
        super().close(**kwargs)

    def _masked(self, options: Info | None) -> tuple[Mask, Info | None]:
        """Return the environments to reset, and the options with the mask as an array. Raises ValueError."""
        got = f"{_MANI_SKILL_MASK}; ManiSkillVectorEnv resets ended environments itself"
        require("options", _MANI_SKILL_MASK not in (options or {}), "a reset of all environments", got)
        if options is None or _RESET_MASK not in options:
            return np.ones(self.num_envs, np.bool_), options
        mask = as_array(options[_RESET_MASK])
        is_mask = mask.dtype == np.bool_ and mask.shape == (self.num_envs,)
        require(_RESET_MASK, is_mask, f"bool [{self.num_envs}]", f"{mask.dtype} {list(mask.shape)}")
        return mask, {**options, _RESET_MASK: mask}

    def _check_was_masked(self, options: Info | None) -> None:
        """Raise ValueError if a vector with its own reset has not read the mask: it may have reset all."""
        is_left = options is not None and _RESET_MASK in options and self._autoreset_mode is not AutoresetMode.DISABLED
        got = f"{type(self.unwrapped).__name__}, which left it there; reset all environments"
        require(_RESET_MASK, not is_left, "a vector that takes it out of the options", got)

    def _check_can_reset(self, twice: Mask) -> None:
        """Raise ValueError where Gymnasium's workers (1.4) would reset again in the next step, despite this reset.

        twice: environments that are due to reset in the next step
        """
        vector = self.unwrapped
        if twice.any() and isinstance(vector, AsyncVectorEnv) and not vector.shared_memory:
            got = f"the environments {np.flatnonzero(twice).tolist()}, which would reset once more in the next step"
            remedy = "take a step before it, or make the AsyncVectorEnv with shared_memory=True"
            raise InvalidValueError.at("reset", "none whose episode has ended", got, remedy)

    @property
    def _resetting(self) -> Mask:
        """Environments that only reset in the next step."""
        return self._envs.ended & (self._autoreset_mode is AutoresetMode.NEXT_STEP)

    def _shown(self, observations: Any) -> Sequence[Any]:
        if self._options.renders:
            rendered = self.env.render()
            shown = [] if rendered is None else list(rendered)
        else:
            shown = list(iterate(self.env.observation_space, observations))
        expected = f"one of each of the {self.num_envs} environments"
        require("frames", len(shown) == self.num_envs, expected, len(shown), InvalidSampleError)
        return shown

    def _frame(self, shown: Sequence[Any] | dict[int, Any], index: int) -> Any:
        return shown[index] if self._options.renders else self._options.frames_of(shown[index])

    def _final_observations(self, infos: Info, ended: Mask) -> dict[int, Any]:
        """Return last observations of ended episodes, whose environments already show the next episode."""
        observations = infos.get("final_obs", [None] * self.num_envs)
        if "final_obs" not in infos and "final_observation" in infos:  # ManiSkill's, a batch like the observations
            observations = list(iterate(self.env.observation_space, infos["final_observation"]))
        final = {index: observations[index] for index in np.flatnonzero(ended).tolist()}
        missing = [index for index, observation in final.items() if observation is None]
        if missing:
            expected = f"final_obs of the environments {missing}, whose episodes ended in this step"
            remedy = f"{_INSTEAD_OF_SAME_STEP}, or a ManiSkillVectorEnv with auto_reset=True"
            raise InvalidSampleError.at("infos", expected, f"none in {list(infos)}; {remedy}")
        return final

    def _with_scores(self, infos: Info, fresh: Mask) -> Info:
        for index in np.flatnonzero(fresh).tolist():
            infos = self._add_info(infos, {INFO: self._envs.episodes[index].info()}, index)
        return infos


def _like(given: Any, values: npt.NDArray[Any]) -> Any:
    """Return the values; if ``given`` is a tensor, as a float32 or bool tensor on its device."""
    if not hasattr(given, "new_tensor"):  # torch may not be installed
        return values
    typed = given.bool() if values.dtype == np.bool_ else given.float()  # ManiSkill's sparse rewards are bool
    return typed.new_tensor(values)


def _of_each(env: VectorEnv, name: str, *args: str) -> Sequence[Any]:
    """Return each environment's attribute or method result; empty if the vector cannot tell."""
    vector = env.unwrapped
    return vector.call(name, *args) if isinstance(vector, (AsyncVectorEnv, SyncVectorEnv)) else ()


def _check_tells_resets(env: VectorEnv, options: RewardOptions) -> None:
    """Raise ValueError for rendered frames from LeRobot's environments in processes: some reset there unseen."""
    modules = _of_each(env, "__module__") if options.renders and isinstance(env.unwrapped, AsyncVectorEnv) else ()
    is_lerobot = any(str(module).startswith("lerobot.envs") for module in modules)
    expected = "a source of frames in the observation, such as 'pixels', for LeRobot's environments in processes"
    require("frames_from", not is_lerobot, expected, "render(), which may show the next episode's first frame")


def _checked_autoreset_mode(env: VectorEnv, options: RewardOptions) -> AutoresetMode:
    mode = env.metadata.get("autoreset_mode")
    instead = (
        "make the vector with autoreset_mode=AutoresetMode.{}, or wrap each environment in RewardModelWrapper instead"
    )
    if not isinstance(mode, AutoresetMode):
        raise InvalidValueError.at("metadata['autoreset_mode']", "an AutoresetMode", repr(mode))
    if mode is AutoresetMode.SAME_STEP and options.renders:
        expected = "NEXT_STEP or DISABLED with frames from render(), which never shows an episode's last frame"
        raise InvalidValueError.at("autoreset_mode", expected, mode.name, instead.format("NEXT_STEP"))
    if mode is not AutoresetMode.DISABLED and options.terminate_on_success is not None:
        expected = "DISABLED with terminate_on_success"
        raise InvalidValueError.at("autoreset_mode", expected, mode.name, instead.format("DISABLED"))
    return mode
