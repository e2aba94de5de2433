# SPDX-License-Identifier: MIT
"""Resets that drop a reward, because the wrapper has not seen the end of the episode."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import Protocol

_INSIDE = (
    "put the time limit inside the wrapper: RewardModelWrapper(TimeLimit(env, steps), ...), "
    "or gymnasium.make(..., max_episode_steps=steps)"
)

logger = logging.getLogger("rfm_client")


class _Episode(Protocol):
    @property
    def index(self) -> int | None: ...
    @property
    def num_steps(self) -> int: ...
    @property
    def is_unpaid(self) -> bool: ...


class UnpaidResets:
    """Tells of resets that drop a reward: once in the log, and in mode ``final`` by an error.

    A single such reset may be deliberate. Two in a row, with no end in between, mean that the episodes of an
    environment end outside the wrapper: then mode ``final`` would never pay.
    """

    def __init__(self, *, refuses: bool) -> None:
        """refuses: True: raise ValueError at the second such reset in a row"""
        self._refuses = refuses
        self._cut: set[int | None] = set()  # environments whose last episode was cut
        self._has_warned = False

    def ended(self, episode: _Episode) -> None:
        """Take note of an end that the wrapper has seen."""
        self._cut.discard(episode.index)

    def check(self, episodes: Iterable[_Episode]) -> None:
        """Check the episodes that a reset is about to cut. Raises ValueError as the class describes."""
        for episode in [episode for episode in episodes if episode.is_unpaid]:
            where = "reset" if episode.index is None else f"envs[{episode.index}]: reset"
            got = f"one after {episode.num_steps} steps, whose reward is lost"
            if self._refuses and episode.index in self._cut:
                self._cut.discard(episode.index)  # a third reset may go on
                got += ", for the second time in a row"
                expected = "the end of an episode before it, where mode 'final' pays"
                raise ValueError(f"{where}: expected {expected}, got {got}; {_INSIDE}")
            self._cut.add(episode.index)
            if not self._has_warned:
                self._has_warned = True
                logger.warning("%s: expected the end of the episode before it, got %s; %s", where, got, _INSIDE)
