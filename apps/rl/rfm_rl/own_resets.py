# SPDX-License-Identifier: MIT
"""Refuse frames from environments that reset in the step that ends an episode."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import gymnasium

from rfm_client import InvalidSampleError
from rfm_rl.rewards import Info, RewardOptions

_ENDS = "final_obs", "final_observation", "terminal_observation"  # in info, if the observation is the next episode's
HAS_RESET = "final_info"  # in info from LeRobot's environments, whose observation is from before the reset


class CopiedObservation(gymnasium.ObservationWrapper[Any, Any, Any]):
    """Copies the environment's observations, for vectors that reset it in another process.

    Such a vector keeps the array of an episode's last frame and resets the environment, which may draw over it.
    """

    copies_observations = True

    def observation(self, observation: Any) -> Any:
        """Return a copy of the observation."""
        return deepcopy(observation)


@contextmanager
def watched_resets(env: gymnasium.Env[Any, Any]) -> Iterator[list[Any]]:
    """Yield a list that grows with each reset during the context."""
    resets: list[Any] = []
    reset = env.unwrapped.reset

    def watched(*args: Any, **options: Any) -> Any:
        resets.append(options)
        return reset(*args, **options)

    with _replaced(env.unwrapped, "reset", watched):
        yield resets


@contextmanager
def copied_steps(env: gymnasium.Env[Any, Any]) -> Iterator[None]:
    """Let steps return copies of their observations during the context."""
    step = env.step

    def copied(action: Any) -> Any:
        observation, *rest = step(action)
        return deepcopy(observation), *rest

    with _replaced(env, "step", copied):
        yield


@contextmanager
def _replaced(owner: Any, name: str, method: Any) -> Iterator[None]:
    own = {name: vars(owner)[name]} if name in vars(owner) else {}  # else the method is the class's
    setattr(owner, name, method)
    try:
        yield
    finally:
        delattr(owner, name)
        vars(owner).update(own)


def check_observes_its_end(info: Info) -> None:
    """Raise InvalidSampleError if the observation is already the next episode's. info: from an episode's last step"""
    found = [key for key in _ENDS if key in info]
    if found:
        expected = f"none of {', '.join(_ENDS)} from an environment that shows the last frame of its episode"
        remedy = "turn off its own reset, and wrap the RewardModelWrapper in gymnasium.wrappers.Autoreset"
        raise InvalidSampleError.at("info", expected, f"{', '.join(found)}; {remedy}")


def check_renders_its_end(options: RewardOptions, where: str, has_reset: bool) -> None:
    """Raise InvalidSampleError if ``render()`` shows the next episode: if an episode's last step has reset."""
    if options.renders and has_reset:
        expected = "no reset in the last step of an episode with frames from render()"
        remedy = "take frames from the observation, such as frames_from='pixels'"
        raise InvalidSampleError.at(where, expected, f"one by the environment itself; {remedy}")
