# SPDX-License-Identifier: MIT
"""The episodes that clients report while they run, as the page shows them. They are in memory alone, and few.

Each answer has a cursor. Asked with it, the next answer has only what is new. No route is known here.
"""

from __future__ import annotations

import itertools
import secrets
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

MOST_EPISODES = 128  # first those go that have ended, then those that have been silent for longest
MOST_POINTS = 1000  # of one curve: the newest
FORGOTTEN_AFTER_S = 300.0  # of silence
_MOST_DIGITS = 15  # of a cursor's number
_COLUMNS = {"steps": "step", "progress": "progress", "success": "success"}  # of a curve, and what a point calls them

Point: TypeAlias = Mapping[str, Any]  # step, progress, success, succeeded, ms; as it was reported


@dataclass(frozen=True)
class News:
    """What a report says of one episode.

    about: its name, env, task and threshold; points: steps that were scored, in their order
    """

    id: str
    about: Mapping[str, Any]
    has_ended: bool
    points: Sequence[Point]


@dataclass
class _Episode:
    """What is known of an episode.

    changed, frame_changed: number of the report that brought the newest of it; changes: of each point
    """

    about: Mapping[str, Any]
    heard_s: float
    changed: int = 0
    has_ended: bool = False
    newest: Point | None = None
    changes: deque[int] = field(default_factory=lambda: deque(maxlen=MOST_POINTS))
    columns: dict[str, deque[Any]] = field(
        default_factory=lambda: {name: deque(maxlen=MOST_POINTS) for name in _COLUMNS}
    )
    frame: bytes | None = None
    frame_changed: int = 0

    def take(self, news: News, changed: int) -> None:
        """Takes over what a report says of it."""
        self.changed = changed
        self.has_ended |= news.has_ended
        for point in news.points:
            if self.newest is None or point["step"] > self.newest["step"]:  # a report may come twice
                self.newest = point
                self.changes.append(changed)
                for column, name in _COLUMNS.items():
                    self.columns[column].append(point[name])

    def since(self, known: int) -> dict[str, Any]:
        """What is new since the report of a number."""
        if self.changed <= known:
            return {}
        num_new = sum(1 for _ in itertools.takewhile(lambda changed: changed > known, reversed(self.changes)))
        first = len(self.changes) - num_new
        return {
            **self.about,
            "has_ended": self.has_ended,
            "frame": self.frame_changed or None,
            "newest": self.newest,
            **{column: list(itertools.islice(values, first, None)) for column, values in self.columns.items()},
        }


class LiveEpisodes:
    """The newest episodes, each with its newest frame and points. For one thread.

    clock_s: gives the time in seconds
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._episodes: dict[str, _Episode] = {}  # first the one that has been silent for longest
        self._changed = 0
        self._life = secrets.token_hex(8)  # a cursor of an earlier gateway is none of this one

    def take(self, news: Iterable[News], frames: Mapping[str, bytes]) -> None:
        """Takes a report over. Of an episode that is not known, an end or a frame alone is left out.

        frames: JPEG files by the episode's id
        """
        self._changed += 1
        for each in news:
            if not each.points and each.id not in self._episodes:
                continue
            episode = self._episodes.pop(each.id, None) or _Episode(each.about, self._clock_s())
            episode.take(each, self._changed)
            episode.heard_s = self._clock_s()
            self._episodes[each.id] = episode
        for key, frame in frames.items():
            if key in self._episodes:
                episode = self._episodes[key]
                episode.frame, episode.frame_changed, episode.changed = frame, self._changed, self._changed
        self._forget()

    def since(self, cursor: str) -> dict[str, Any]:
        """All episodes, and of those that have changed since a cursor what is new. The answer has the next cursor.

        cursor: of an earlier answer; any other text: nothing is known yet
        """
        self._forget()
        life, _, number = cursor.partition(".")
        is_number = number.isascii() and number.isdecimal() and len(number) <= _MOST_DIGITS
        known = int(number) if life == self._life and is_number else 0
        return {
            "cursor": f"{self._life}.{self._changed}",
            "is_whole": known == 0,
            "most_points": MOST_POINTS,
            "episodes": [
                {"id": key, "age_s": self._clock_s() - episode.heard_s, **episode.since(known)}
                for key, episode in self._episodes.items()
            ],
        }

    def frame(self, key: str) -> bytes | None:
        """The newest frame of an episode, a JPEG file; None: there is none."""
        episode = self._episodes.get(key)
        return None if episode is None else episode.frame

    def _forget(self) -> None:
        oldest_s = self._clock_s() - FORGOTTEN_AFTER_S
        silent = [key for key, episode in self._episodes.items() if episode.heard_s < oldest_s]
        for key in silent:
            del self._episodes[key]
        ended_first = sorted(self._episodes, key=lambda key: not self._episodes[key].has_ended)
        for key in ended_first[: max(0, len(ended_first) - MOST_EPISODES)]:
            del self._episodes[key]
