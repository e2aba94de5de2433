# SPDX-License-Identifier: MIT
"""Vectors of Gymnasium environments with the reward of a served reward model. ``gym.py`` states the rules.

A vector may return torch tensors on a GPU, as ManiSkillVectorEnv does. Nothing here imports torch.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.vector.utils import iterate

from rfm_client import InvalidSampleError, as_array
from rfm_client.options import InvalidValueError, require
from rfm_rl.gym import DEFAULTS, INFO, LOST, check_frame_source, check_kind, tasks_of
from rfm_rl.own_rewards import RETURNS, correct_statistics, refuse_statistics
from rfm_rl.rewards import ClientSource, Info, RewardedEpisode, Rewarder, RewardOptions

OfEnvs: TypeAlias = dict[int, RewardedEpisode]  # by number of the environment
Mask: TypeAlias = npt.NDArray[np.bool_]

_INSTEAD_OF_SAME_STEP = "make the vector with autoreset_mode=AutoresetMode.NEXT_STEP"
_MANI_SKILL_MASK = "env_idx"  # ManiSkill's key in the options of a reset
_RESET_MASK = "reset_mask"  # key in the options of a reset, which Gymnasium's vectors remove


class RewardModelVectorWrapper(VectorWrapper):
    """A vector environment with the reward of a reward model.

    With ``blocking``, a step scores all sub-environments in one call.

    client: as in RewardModelWrapper
    task: one task sentence for all sub-environments, or a sequence with a sentence for each

    Rewards are float64 [num_envs]. If ``env`` returns tensors, they are a float32 tensor on its device; terminations
    are a tensor, too. ``infos["reward_model"]`` has arrays and masks, like Gymnasium's own infos. The mode of autoreset
    matters:

    - SAME_STEP: the last scores of an ended episode are in ``infos["final_info"]``.
    - NEXT_STEP: a step that only resets a sub-environment has reward 0, as in Gymnasium. It waits for the score of that
      frame even when not blocking.
    - DISABLED: a step after an episode's end raises ResetNeeded.

    Raises ValueError if ``options`` names a source of frames that ``env`` lacks; for SAME_STEP with frames from
    ``render()``, which never shows an episode's last frame; and for ``terminate_on_success`` unless DISABLED, because
    an environment that resets by itself does not know of the success. In these two cases, wrap each sub-environment in
    RewardModelWrapper instead. Raises ValueError, too, for ``terminate_on_success`` with a RecordEpisodeStatistics
    inside, which would miss that end; TypeError if ``env`` is no ``gymnasium.vector.VectorEnv``.
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
        autoreset_mode = _checked_autoreset_mode(env, options)
        if options.terminate_on_success is not None and _has_statistics(env):
            refuse_statistics(options.terminate_on_success, "RecordEpisodeStatistics(RewardModelVectorWrapper(...))")
        tasks = tasks_of(task, env.num_envs)
        super().__init__(env)  # after the checks: a refused wrapper must not close the environments when collected
        self._rewarder = Rewarder(client, options)
        self._options = options
        self._autoreset_mode = autoreset_mode
        self._tasks = tasks
        self._episodes: OfEnvs = {}
        self._whole: Mask = np.zeros(env.num_envs, np.bool_)  # all frames of the episode are kept
        self._ended: Mask = np.zeros(env.num_envs, np.bool_)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Reset the environments, or those in ``reset_mask``, and score their first frames.

        options: passed on; ``reset_mask`` may be an array, a list or a tensor, bool [num_envs]

        Raises RewardError; ValueError for a wrong mask, a vector that does not read it, and as RewardModelWrapper.
        """
        reset_mask, options = self._masked(options)
        self._check_can_reset(self._resetting & reset_mask)
        indices = np.flatnonzero(reset_mask).tolist()
        before = [self._episodes[index] for index in indices if index in self._episodes]
        self._rewarder.check_reset(self._episodes[index] for index in np.flatnonzero(reset_mask & self._whole).tolist())
        whole, self._whole = self._whole, np.zeros_like(self._whole)
        observations, infos = self.env.reset(seed=seed, options=options)
        self._check_was_masked(options)
        self._whole, self._ended = whole & ~reset_mask, self._ended & ~reset_mask
        for episode in before:
            episode.end()
        shown = self._shown(observations)
        fresh = {index: self._begin(index, self._frame(shown[index])) for index in indices}
        self._rewarder.score(dict.fromkeys(fresh.values(), False))
        return observations, self._with_scores(infos, fresh)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, Info]:
        """Step the environments; return the model's rewards, [num_envs]. Raises RewardError, ResetNeeded."""
        self._check_can_step()
        resetting = self._resetting
        self._whole = np.zeros_like(self._whole)  # until each frame is kept
        observations, env_rewards, terminations, truncations, infos = self.env.step(actions)
        terminated, truncated = (as_array(each).astype(np.bool_) for each in (terminations, truncations))
        paid = as_array(env_rewards)
        self._ended = ended = terminated | truncated
        stepped, fresh, final = self._added(self._shown(observations), infos, resetting)
        self._rewarder.score(
            {episode: bool(ended[index]) for index, episode in stepped.items()} | dict.fromkeys(fresh.values(), False)
        )
        rewards = np.zeros(self.num_envs)
        for index, episode in stepped.items():
            rewards[index] = episode.reward(float(paid[index]), bool(terminated[index]))
            correct_statistics(infos, index, episode)
            scores: Info = {INFO: episode.info()}
            infos = self._add_info(infos, {"final_info": scores} if index in final else scores, index)
        terminated = terminated | self._succeeded()
        infos = self._with_scores(infos, fresh)
        return observations, _like(env_rewards, rewards), _like(terminations, terminated), truncations, infos

    def close(self, **kwargs: Any) -> None:
        """Cancel open requests; close the environments, and the client if it was made here."""
        for episode in self._episodes.values():
            episode.end()
        self._rewarder.close()
        super().close(**kwargs)

    def _masked(self, options: Info | None) -> tuple[Mask, Info | None]:
        """The environments to reset, and the options with the mask as an array. Raises ValueError."""
        got = f"{_MANI_SKILL_MASK}; ManiSkillVectorEnv resets ended environments itself"
        require("options", _MANI_SKILL_MASK not in (options or {}), "a reset of all environments", got)
        if options is None or _RESET_MASK not in options:
            return np.ones(self.num_envs, np.bool_), options
        mask = as_array(options[_RESET_MASK])
        is_mask = mask.dtype == np.bool_ and mask.shape == (self.num_envs,)
        require(_RESET_MASK, is_mask, f"bool [{self.num_envs}]", f"{mask.dtype} {list(mask.shape)}")
        return mask, {**options, _RESET_MASK: mask}

    def _check_was_masked(self, options: Info | None) -> None:
        """Raise ValueError if a vector with a reset of its own has not read the mask: it may have reset all."""
        is_left = options is not None and _RESET_MASK in options and self._autoreset_mode is not AutoresetMode.DISABLED
        got = f"{type(self.unwrapped).__name__}, which left it there; reset all environments"
        require(_RESET_MASK, not is_left, "a vector that takes it out of the options", got)

    def _check_can_reset(self, twice: Mask) -> None:
        """Raise ValueError where workers of Gymnasium (1.4) would reset again in the next step, despite this reset.

        twice: environments that are due to reset in the next step
        """
        vector = self.unwrapped
        if twice.any() and isinstance(vector, AsyncVectorEnv) and not vector.shared_memory:
            got = f"the environments {np.flatnonzero(twice).tolist()}, which would reset once more in the next step"
            remedy = "take a step before it, or make the AsyncVectorEnv with shared_memory=True"
            raise InvalidValueError.at("reset", "none whose episode has ended", got, remedy)

    def _check_can_step(self) -> None:
        if len(self._episodes) != self.num_envs:
            raise ResetNeeded("step: expected a reset of every environment before it")
        is_caller_s = self._autoreset_mode is AutoresetMode.DISABLED  # the caller resets
        over = (self._ended | self._succeeded()) & is_caller_s
        for indices, reason in ((over, "their episodes have ended"), (~self._whole & ~self._resetting, LOST)):
            if indices.any():
                expected = f"expected a reset of the environments {np.flatnonzero(indices).tolist()}, since {reason}"
                remedy = 'call reset, for some environments with options={"reset_mask": mask}'
                raise ResetNeeded(f"step: {expected}, got another step; {remedy}")

    @property
    def _resetting(self) -> Mask:
        """Environments that only reset in the next step."""
        return self._ended & (self._autoreset_mode is AutoresetMode.NEXT_STEP)

    def _succeeded(self) -> Mask:
        return np.array([episode.succeeded for _, episode in sorted(self._episodes.items())], np.bool_)

    def _added(self, shown: Sequence[Any], infos: Info, resetting: Mask) -> tuple[OfEnvs, OfEnvs, Collection[int]]:
        """Add the frames of a step, each as soon as it is made: it may reuse the array of the frame before.

        Returns the continued episodes, the new episodes, and the environments with both (SAME_STEP).
        """
        final = self._final_observations(infos) if self._autoreset_mode is AutoresetMode.SAME_STEP else {}
        stepped = {index: self._episodes[index] for index in np.flatnonzero(~resetting).tolist()}
        last = {}
        for index, episode in stepped.items():
            frame = self._frame(final.get(index, shown[index]))
            if index in final:
                last[index] = frame = copied(frame)
            episode.steps.keep(frame)
            self._whole[index] = index not in final
        fresh = {}
        for index in (*np.flatnonzero(resetting).tolist(), *final):
            if index not in final:
                self._episodes[index].end()
            frame = self._frame(shown[index])
            fresh[index] = self._begin(index, frame)
            if index in final:
                check_differ(f"final_obs[{index}]", last[index], copied(frame), _INSTEAD_OF_SAME_STEP)
        return stepped, fresh, final

    def _begin(self, index: int, frame: Any) -> RewardedEpisode:
        self._episodes[index] = self._rewarder.begin(self._tasks[index], frame, index)
        self._whole[index] = True
        return self._episodes[index]

    def _shown(self, observations: Any) -> Sequence[Any]:
        if self._options.renders:
            rendered = self.env.render()
            shown = [] if rendered is None else list(rendered)
        else:
            shown = list(iterate(self.env.observation_space, observations))
        expected = f"one of each of the {self.num_envs} environments"
        require("frames", len(shown) == self.num_envs, expected, len(shown), InvalidSampleError)
        return shown

    def _frame(self, shown: Any) -> Any:
        return shown if self._options.renders else self._options.frames_of(shown)

    def _final_observations(self, infos: Info) -> dict[int, Any]:
        """Last observations of ended episodes, whose environments already show the next episode."""
        observations = infos.get("final_obs", [None] * self.num_envs)
        if "final_obs" not in infos and "final_observation" in infos:  # ManiSkill's, a batch like the observations
            observations = list(iterate(self.env.observation_space, infos["final_observation"]))
        final = {index: observations[index] for index in np.flatnonzero(self._ended).tolist()}
        missing = [index for index, observation in final.items() if observation is None]
        if missing:
            expected = f"final_obs of the environments {missing}, whose episodes ended in this step"
            remedy = f"{_INSTEAD_OF_SAME_STEP}, or a ManiSkillVectorEnv with auto_reset=True"
            raise InvalidSampleError.at("infos", expected, f"none in {list(infos)}; {remedy}")
        return final

    def _with_scores(self, infos: Info, fresh: OfEnvs) -> Info:
        for index, episode in fresh.items():
            infos = self._add_info(infos, {INFO: episode.info()}, index)
        return infos


def _like(given: Any, values: npt.NDArray[Any]) -> Any:
    """The values, as a tensor on the device of ``given`` if this is a tensor: float32, or bool."""
    if not hasattr(given, "new_tensor"):  # torch may not be installed
        return values
    typed = given.bool() if values.dtype == np.bool_ else given.float()  # ManiSkill's sparse rewards are bool
    return typed.new_tensor(values)


def copied(frame: Any) -> Any:
    """Return a copy of a frame, or of a dict of frames by camera."""
    if isinstance(frame, Mapping):
        return {camera: np.array(as_array(each)) for camera, each in frame.items()}
    return np.array(as_array(frame))


def check_differ(where: str, last: Any, first: Any, instead: str) -> None:
    """Raise InvalidSampleError if a reset has drawn over the last frame of the episode before.

    instead: remedy where the environment cannot return a copy
    """
    of_cameras = [(last[camera], first[camera]) for camera in last] if isinstance(last, Mapping) else [(last, first)]
    if any(np.array_equal(*pair) for pair in of_cameras):
        got = "the first frame of the next one: the environment seems to draw into the array that it has returned"
        remedy = f"let it return a copy of its observation, or {instead}"
        raise InvalidSampleError.at(where, "the last frame of the ended episode", f"{got}; {remedy}")


def _has_statistics(env: VectorEnv) -> bool:
    """True with a RecordEpisodeStatistics around the vector or around environments in it."""
    if isinstance(env, VectorWrapper):
        return hasattr(env, RETURNS) or _has_statistics(env.env)
    return isinstance(env, (AsyncVectorEnv, SyncVectorEnv)) and any(env.call("has_wrapper_attr", RETURNS))


def _checked_autoreset_mode(env: VectorEnv, options: RewardOptions) -> AutoresetMode:
    mode = env.metadata.get("autoreset_mode")
    instead = "wrap each environment in RewardModelWrapper instead"
    if not isinstance(mode, AutoresetMode):
        raise InvalidValueError.at("metadata['autoreset_mode']", "an AutoresetMode", repr(mode))
    if mode is AutoresetMode.SAME_STEP and options.renders:
        expected = "NEXT_STEP or DISABLED with frames from render(), which never shows an episode's last frame"
        raise InvalidValueError.at("autoreset_mode", expected, mode.name, instead)
    if mode is not AutoresetMode.DISABLED and options.terminate_on_success is not None:
        raise InvalidValueError.at("autoreset_mode", "DISABLED with terminate_on_success", mode.name, instead)
    return mode
