# SPDX-License-Identifier: MIT
"""The wrappers as one interface: of single environments, of vectors in each autoreset mode, and of Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from coded_env import CodedEnv
from rfm_client import RewardClient
from rfm_rl import RewardModelVectorWrapper, RewardModelWrapper, RewardOptions

Info = dict[str, Any]
Maker = Callable[[], gym.Env[Any, Any]]

BY_CALLER, NEXT_STEP, SAME_STEP = "by the caller", "in the next step", "in the same step"  # who resets, and when
TASKS = ("task 0", "task 1")


@dataclass(frozen=True)
class Said:
    """What a step says of one environment. begun: info of a reset in the same step"""

    reward: float
    terminated: bool
    truncated: bool
    info: Info
    begun: Info | None = None

    @property
    def ends(self) -> bool:
        return self.terminated or self.truncated


@dataclass
class Played:
    """An episode. infos: first that of the reset"""

    infos: list[Info]
    rewards: list[float] = field(default_factory=list)
    terminated: bool = False
    truncated: bool = False


class Door:
    """A wrapper around environments. resets: who resets; asks_once: a step of all environments is one request"""

    resets: ClassVar[str]
    asks_once: ClassVar[bool] = True

    def __init__(self, makers: Sequence[Maker], client: RewardClient, options: RewardOptions) -> None:
        self.num_envs = len(makers)
        self.wrap(makers, client, list(TASKS[: self.num_envs]), options)

    def wrap(self, makers: Sequence[Maker], client: RewardClient, tasks: list[str], options: RewardOptions) -> None:
        raise NotImplementedError

    def reset(self, mask: Sequence[bool] | None = None) -> dict[int, Info]:
        """Return the info of each environment. mask: those to reset, for a door that the caller resets"""
        raise NotImplementedError

    def step(self) -> list[Said]:
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError

    def __enter__(self) -> Door:
        return self

    def __exit__(self, *_raised: object) -> None:
        self.close()


class Single(Door):
    """Each environment in a wrapper of its own."""

    resets, asks_once = BY_CALLER, False

    def wrap(self, makers: Sequence[Maker], client: RewardClient, tasks: list[str], options: RewardOptions) -> None:
        pairs = zip(makers, tasks, strict=True)
        self.envs = [RewardModelWrapper(make(), client, task, options) for make, task in pairs]

    def reset(self, mask: Sequence[bool] | None = None) -> dict[int, Info]:
        return {index: env.reset()[1] for index, env in enumerate(self.envs) if mask is None or mask[index]}

    def step(self) -> list[Said]:
        return [Said(*env.step(0)[1:]) for env in self.envs]

    def close(self) -> None:
        for env in self.envs:
            env.close()


class Vector(Door):
    """A vector of Gymnasium. mode: its autoreset mode"""

    mode: ClassVar[AutoresetMode]
    kind: Callable[..., Any] = SyncVectorEnv

    def wrap(self, makers: Sequence[Maker], client: RewardClient, tasks: list[str], options: RewardOptions) -> None:
        self.env = RewardModelVectorWrapper(self.kind(makers, autoreset_mode=self.mode), client, tasks, options)

    def reset(self, mask: Sequence[bool] | None = None) -> dict[int, Info]:
        infos = self.env.reset(options=None if mask is None else {"reset_mask": list(mask)})[1]
        return {index: info_of(infos, index) for index in range(self.num_envs) if mask is None or mask[index]}

    def step(self) -> list[Said]:
        _, rewards, terminations, truncations, infos = self.env.step(np.zeros(self.num_envs, int))
        said = []
        for index in range(self.num_envs):
            ends = bool(terminations[index]), bool(truncations[index])
            info, begun = info_of(infos, index), None
            if any(ends) and self.mode is AutoresetMode.SAME_STEP:
                info, begun = info_of(infos["final_info"], index), info
            said.append(Said(float(rewards[index]), *ends, info, begun))
        return said

    def close(self) -> None:
        self.env.close()


class NextStep(Vector):
    resets, mode = NEXT_STEP, AutoresetMode.NEXT_STEP


class SameStep(Vector):
    resets, mode = SAME_STEP, AutoresetMode.SAME_STEP


class Disabled(Vector):
    resets, mode = BY_CALLER, AutoresetMode.DISABLED


class InProcesses(SameStep):
    kind = partial(AsyncVectorEnv, context="spawn")


class Sb3(Door):
    """A ``VecEnv`` of Stable-Baselines3, each environment in RenderedFrame if frames are rendered."""

    resets = SAME_STEP
    kind = "DummyVecEnv"

    def wrap(self, makers: Sequence[Maker], client: RewardClient, tasks: list[str], options: RewardOptions) -> None:
        vectors = pytest.importorskip("stable_baselines3.common.vec_env", reason="the extra sb3 is not installed")
        from rfm_rl.sb3 import RenderedFrame, RewardModelVecEnv

        made = [partial(_wrapped, RenderedFrame, make) for make in makers] if options.renders else list(makers)
        context = {"start_method": "spawn"} if self.kind == "SubprocVecEnv" else {}
        self.env = RewardModelVecEnv(getattr(vectors, self.kind)(made, **context), client, tasks, options)

    def reset(self, mask: Sequence[bool] | None = None) -> dict[int, Info]:
        self.env.reset()
        assert not [key for info in self.env.reset_infos for key in info if "frame" in key]  # those of RenderedFrame
        return dict(enumerate(self.env.reset_infos))

    def step(self) -> list[Said]:
        _, rewards, dones, infos = self.env.step(np.zeros(self.num_envs, int))
        assert (rewards.dtype, rewards.shape) == (np.float32, (self.num_envs,))
        said = []
        assert not [key for info in (*infos, *self.env.reset_infos) for key in info if "frame" in key]
        for index, (done, info) in enumerate(zip(dones.tolist(), infos, strict=True)):
            truncated = done and info["TimeLimit.truncated"]
            begun = self.env.reset_infos[index] if done else None
            said.append(Said(float(rewards[index]), done and not truncated, truncated, info, begun))
        return said

    def close(self) -> None:
        self.env.close()


class Sb3InProcesses(Sb3):
    kind = "SubprocVecEnv"


def _wrapped(wrapper: Any, make: Maker) -> Any:
    return wrapper(make())


def info_of(infos: Mapping[str, Any], index: int) -> Info:
    """Return one environment's info of a vector: the values whose masks have it."""
    found: Info = {}
    for key, values in infos.items():
        if f"_{key}" in infos and infos[f"_{key}"][index]:
            found[key] = info_of(values, index) if isinstance(values, Mapping) else values[index]
    return found


VECTORS: dict[str, type[Door]] = {"NEXT_STEP": NextStep, "SAME_STEP": SameStep, "DISABLED": Disabled, "VecEnv": Sb3}
DOORS: dict[str, type[Door]] = {"single": Single, **VECTORS}
ENDED_BY_SUCCESS = {"single": Single, "DISABLED": Disabled}


def makers_of(envs: Sequence[gym.Env[Any, Any]]) -> list[Maker]:
    """Return a function for each environment that returns it."""
    return [partial(_same, env) for env in envs]


def _same(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    return env


def played(door: Door, calls: int) -> list[list[Played]]:
    """Return the episodes of each environment after a reset and some further calls."""
    episodes = [[Played([info])] for info in door.reset().values()]
    ended = [False] * door.num_envs
    for _ in range(calls):
        if door.resets == BY_CALLER and any(ended):
            for index, info in door.reset(ended).items():
                episodes[index].append(Played([info]))
            ended = [False] * door.num_envs
            continue
        for index, said in enumerate(door.step()):
            if ended[index] and door.resets == NEXT_STEP:
                assert (said.reward, said.ends) == (0, False)
                episodes[index].append(Played([said.info]))
                ended[index] = False
                continue
            episode = episodes[index][-1]
            episode.rewards.append(said.reward)
            episode.infos.append(said.info)
            episode.terminated, episode.truncated = said.terminated, said.truncated
            if said.begun is not None:
                episodes[index].append(Played([said.begun]))
            ended[index] = said.ends and said.begun is None
    return episodes


def go_on(door: Door, envs: Sequence[CodedEnv]) -> None:
    """Step a door, or reset ended environments if the caller has to: a step before it is refused."""
    ended = [env.has_ended for env in envs]
    if door.resets == BY_CALLER and any(ended):
        with pytest.raises(
            ResetNeeded, match=r"^step: expected a reset.*(has|have) ended, got another step; call reset"
        ):
            door.step()
        door.reset(ended)
    else:
        door.step()
