# SPDX-License-Identifier: MIT
"""Refuse or correct every use of the environment's own reward."""

from __future__ import annotations

import warnings
from typing import Any, NoReturn

import numpy as np

from rfm_rl.rewards import Info, RewardedEpisode

RELABELS = "compute_reward"  # method of an environment that rewards a step for another goal
RETURNS = "episode_returns"  # attribute of Monitor and RecordEpisodeStatistics
_STATISTICS = "episode"  # key in info, of Monitor and RecordEpisodeStatistics


def refuse_relabelling(*_args: object, **_kwargs: object) -> NoReturn:
    """Raise NotImplementedError: a reward for another goal would be the environment's own."""
    expected = "no rewards for other goals, since the reward model scores frames and a task sentence"
    remedy = "turn off hindsight relabelling (HerReplayBuffer); other replay buffers keep the model's rewards"
    raise NotImplementedError(f"{RELABELS}: expected {expected}, got a call; {remedy}")


def with_statistics(info: Info, episode: RewardedEpisode, *, has_statistics: bool = False) -> Info:
    """Return the info of a step. Statistics from a Monitor inside the wrapper show the model's rewards.

    has_statistics: True: a Monitor inside tells of ends, but does not see one by ``terminate_on_success``
    """
    told = info.get(_STATISTICS)
    if isinstance(told, dict) and "r" in told:
        return {**info, _STATISTICS: {**told, **_statistics(episode)}}
    return {**info, _STATISTICS: _statistics(episode)} if has_statistics and episode.succeeded else info


def correct_statistics(infos: Info, index: int, episode: RewardedEpisode, *, has_statistics: bool) -> Info:
    """Return what to add to the infos of a Gymnasium vector, whose statistics now show the model's rewards."""
    places: list[Any] = [infos, infos.get("final_info")]
    told = [info for info in places if isinstance(info, dict) and f"_{_STATISTICS}" in info]
    for info in told:
        info[f"_{_STATISTICS}"] = np.array(info[f"_{_STATISTICS}"])  # which RecordEpisodeStatistics goes on to read
    shown = [info[_STATISTICS] for info in told if info[f"_{_STATISTICS}"][index]]
    for statistics in shown:
        for key, value in _statistics(episode).items():
            if key in statistics:
                statistics[key][index] = value
    return with_statistics({}, episode, has_statistics=has_statistics and not shown)


def _statistics(episode: RewardedEpisode) -> dict[str, float]:
    return {"r": episode.total_reward, "l": episode.steps.step}


class _HasFile(type):
    def __instancecheck__(cls, env: Any) -> bool:
        return getattr(env, "results_writer", None) is not None


class WritingMonitor(metaclass=_HasFile):
    """Matches, in ``isinstance``, a Monitor that writes a file. A ``VecEnv`` can look for it in its processes."""


def warn_of_file(where: str, outside: str) -> None:
    """Warn that a Monitor inside writes the environment's rewards to its file.

    outside: what to make instead
    """
    expected, got = "no Monitor inside that writes a file", "one that writes the environment's own rewards"
    warnings.warn(f"{where}: expected {expected}, got {got}; write {outside}", stacklevel=4)
