# SPDX-License-Identifier: MIT
"""Match LeRobot rows to video frames by time, as LeRobot's reader does.

A row's frame is the one nearest to the episode's start in the video plus the row's time, within a tolerance. Frames
without a row, from discarded takes and trimmed episodes, are skipped. Two rows with the same frame are an error:
LeRobot reads them, but an episode's start or length must be wrong.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from rfm_client.frames import Video
from rfm_labels.datasets.faults import DatasetError
from rfm_labels.datasets.stored_files import Times

TOLERANCE_S = 1e-4  # LeRobot's default

Frames: TypeAlias = npt.NDArray[np.int64]

_AGAIN = "write the dataset again, or leave this episode out (--episodes)"


@dataclass(frozen=True, eq=False)
class Part:
    """One episode's rows in a video. times_s: float64 [T], rising, in the video."""

    number: int
    where: str
    times_s: Times


@dataclass(frozen=True, eq=False)
class VideoRows:
    """A video, and the rows known to lie in it.

    fps: rows per second
    tolerance_s: largest gap between a row and its frame
    """

    camera: str
    video: Video
    parts: Sequence[Part]
    fps: float
    tolerance_s: float

    @cached_property
    def frames(self) -> Mapping[int, Frames | DatasetError]:
        """Frame numbers by episode, int64 [T], or a faulty episode's error."""
        best, *others = self._matches
        starts = np.cumsum([0, *(len(part.times_s) for part in self.parts)])
        found: dict[int, Frames | DatasetError] = {}
        for part, start, end in zip(self.parts, starts[:-1], starts[1:], strict=True):
            found[part.number] = best.frames[start:end]
            if best.is_faulty[start:end].any():
                found[part.number] = self._fault(best, part, slice(start, end))
            elif any(other.is_faulty.sum() == best.is_faulty.sum() for other in others):
                expected = "times that count from 0 s or from the first frame"
                got = (
                    f"a frame at each time from both, and the first at {self.video.packets.times_s[0]:.4f} s; {_AGAIN}"
                )
                found[part.number] = DatasetError.at(f"{part.where}: {self._where}", expected, got)
        return found

    def apart_s(self, frames: Frames) -> float:
        """Return the shortest time between one of these frames and a neighbour, at most the row interval."""
        gaps_s = np.diff(self.video.packets.times_s, prepend=-np.inf, append=np.inf)
        return min(1 / self.fps, float(np.minimum(gaps_s[frames], gaps_s[frames + 1]).min()))

    @property
    def _where(self) -> str:
        return f"{self.camera}: {self.video.file}"

    @cached_property
    def _rows_s(self) -> Times:
        return np.concatenate([part.times_s for part in self.parts])

    @cached_property
    def _matches(self) -> list[_Match]:
        """Matches, best first. LeRobot counts times from 0; if a video begins later, they may count from its start."""
        times_s = self.video.packets.times_s
        zeros_s = [times_s[0], 0.0] if times_s[0] > self.tolerance_s else [0.0]
        rounding_s = min(self.video.packets.tick_s, 0.25 / self.fps)
        float32_s = np.spacing(self._rows_s.astype(np.float32)).astype(np.float64)
        tolerances_s = max(self.tolerance_s, rounding_s) + float32_s
        matches = [_Match.of(times_s, zero_s + self._rows_s, tolerances_s) for zero_s in zeros_s]
        return sorted(matches, key=lambda match: int(match.is_faulty.sum()))

    def _fault(self, match: _Match, part: Part, rows: slice) -> DatasetError:
        """The error for an episode's first faulty row."""
        k = rows.start + int(np.argmax(match.is_faulty[rows]))
        times_s, frame, expected_s = self.video.packets.times_s, match.frames[k], match.expected_s[k]
        where = f"{part.where}, row {k - rows.start}: {self._where}"
        if not match.is_far[k]:
            got = f"that of {self._other_row(match, k)}; {_AGAIN}"
            return DatasetError.at(where, f"a frame of its own at {expected_s:.4f} s", got)
        got = f"one at {times_s[frame]:.4f} s{self._rates}; {self._remedy(match, rows)}"
        return DatasetError.at(where, f"its frame at {expected_s:.4f} s", got)

    def _other_row(self, match: _Match, k: int) -> str:
        rows = [f"{part.where}, row {t}" for part in self.parts for t in range(len(part.times_s))]
        same = np.flatnonzero((match.frames == match.frames[k]) & ~match.is_far)
        return rows[int(same[same != k][0])]

    @property
    def _rates(self) -> str:
        """A note on the video's and the rows' frame rates; empty if they are equal."""
        if not self.video.packets.fps or f"{self.video.packets.fps:.2f}" == f"{self.fps:.2f}":
            return ""
        return f" (the video has {self.video.packets.fps:.2f} frames a second, meta/info.json says {self.fps:g})"

    def _remedy(self, match: _Match, rows: slice) -> str:
        num_frames, num_rows = len(self.video.packets.times_s), len(self._rows_s)
        if num_frames < num_rows and not self._rates:
            return (
                f"the video has {num_frames} frames for {num_rows} rows, as if some were dropped in recording; {_AGAIN}"
            )
        if self._rates and len(self._rows_s) == len(self.video.packets.times_s):
            return "give both the same rate"
        late_s = match.late_s[rows]
        most_s = math.ceil(np.abs(late_s).max() * 1e4) / 1e4
        varies = np.ptp(late_s) > self.tolerance_s
        is_alone = (np.bincount(match.frames)[match.frames[rows]] == 1).all()
        if not self._rates and varies and is_alone and most_s < 0.5 / self.fps:
            clock = f"if its rows have the times of a clock, take the nearest frames with --tolerance-s {most_s:g}"
            return f"{clock}, as LeRobot does with its tolerance_s; else {_AGAIN}"
        return _AGAIN


@dataclass(frozen=True, eq=False)
class _Match:
    """The nearest frame for each of N rows, among M frames.

    frames: int64 [N], frame number
    expected_s, late_s: float64 [N], the row's time in the video, and its delay after the frame's time
    is_far: bool [N], the frame is too far away
    num_rows: int64 [M], rows per frame
    """

    frames: Frames
    expected_s: Times
    late_s: Times
    is_far: npt.NDArray[np.bool_]
    num_rows: Frames

    @classmethod
    def of(cls, times_s: Times, expected_s: Times, tolerances_s: Times) -> _Match:
        after = np.clip(np.searchsorted(times_s, expected_s), 1, max(len(times_s) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(times_s) - 1)
        frames = np.where(expected_s - times_s[before] <= times_s[after] - expected_s, before, after)
        late_s = expected_s - times_s[frames]
        is_far = np.abs(late_s) > tolerances_s
        num_rows = np.bincount(frames[~is_far], minlength=len(times_s))
        return cls(frames, expected_s, late_s, is_far, num_rows)

    @cached_property
    def is_faulty(self) -> npt.NDArray[np.bool_]:
        """bool [N], the row has no frame of its own."""
        return self.is_far | (self.num_rows[self.frames] > 1)
