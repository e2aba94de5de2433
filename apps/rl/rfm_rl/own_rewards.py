# SPDX-License-Identifier: MIT
"""Refuse or correct every use of the environment's own reward."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, NoReturn

from rfm_client.episodes import SuccessRule
from rfm_client.options import InvalidValueError
from rfm_rl.rewards import Info, RewardedEpisode

RELABELS = "compute_reward"  # method of an environment that rewards a step for another goal
RETURNS = "episode_returns"  # attribute of Monitor and RecordEpisodeStatistics
_STATISTICS = "episode"  # key in info, of Monitor and RecordEpisodeStatistics


def refuse_relabelling(*_args: object, **_kwargs: object) -> NoReturn:
    """Raise NotImplementedError: a reward for another goal would be the environment's own."""
    expected = "no rewards for other goals, since the reward model scores frames and a task sentence"
    remedy = "turn off hindsight relabelling (HerReplayBuffer); other replay buffers keep the model's rewards"
    raise NotImplementedError(f"{RELABELS}: expected {expected}, got a call; {remedy}")


def refuse_statistics(rule: SuccessRule, instead: str) -> NoReturn:
    """Raise ValueError for statistics inside, which would miss the ends by ``terminate_on_success``.

    instead: what to make instead
    """
    expected = "None with a Monitor or RecordEpisodeStatistics inside, which does not see this end"
    raise InvalidValueError.at("terminate_on_success", expected, rule, f"wrap in the other order: {instead}")


def with_statistics(info: Info, episode: RewardedEpisode) -> Info:
    """Return the info of a step. Statistics from a Monitor inside the wrapper show the model's rewards."""
    told = info.get(_STATISTICS)
    if not isinstance(told, dict) or "r" not in told:
        return info
    return {**info, _STATISTICS: {**told, **_statistics(episode)}}


def correct_statistics(infos: Info, index: int, episode: RewardedEpisode) -> None:
    """Let statistics in the infos of a Gymnasium vector show the model's rewards of one environment."""
    for info in (infos, infos.get("final_info")):
        if isinstance(info, Mapping) and f"_{_STATISTICS}" in info and info[f"_{_STATISTICS}"][index]:
            for key, value in _statistics(episode).items():
                if key in info[_STATISTICS]:
                    info[_STATISTICS][key][index] = value


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
