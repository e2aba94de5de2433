# SPDX-License-Identifier: MIT
"""Which frames of a LeRobot film are which rows: as many frames as rows in all, each at its row's time.

A film may begin at another time than its rows, for all of them alike. Whatever else differs is refused: nothing tells
which row a frame belongs to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rfm_client.data.datasets.films import Packets, Span, Times
from rfm_client.data.datasets.protocol import Contents, DatasetError

TOLERANCE_S = 1e-4  # LeRobot's own between the time of a row and that of its frame

_CONTAINER = {".mp4": "mov"}  # FFmpeg's names by suffix: a play list of another's would be read as what it names
_AGAIN = "write the dataset again, or leave this film's episodes out (--episodes)"


@dataclass(frozen=True, eq=False)
class Part:
    """An episode in a film. times_s: float64 [T], of its rows, in the film; where: names it in messages"""

    index: int
    where: str
    times_s: Times


@dataclass(frozen=True, eq=False)
class Film:
    """A film whose frames are its episodes' rows, one by one. frames: those of each episode, by its index"""

    file: Path
    packets: Packets
    frames: Mapping[int, slice]

    @classmethod
    def read(cls, file: Path, camera: str, parts: Sequence[Part], fps: float) -> Film:
        """The film of these episodes, which are all that lie in it. Raises DatasetError where frames and rows differ.

        fps: frames a second, as ``info.json`` says
        """
        parts = sorted(parts, key=lambda part: float(part.times_s[0]))
        packets = Packets.read(file, _CONTAINER.get(file.suffix.lower()))
        ends = np.cumsum([0, *(len(part.times_s) for part in parts)]).tolist()
        if len(packets.times_s) != ends[-1]:
            where = " to ".join(dict.fromkeys((parts[0].where, parts[-1].where)))
            got = f"{len(packets.times_s)}{_rates(packets, fps)}; {_AGAIN}"
            raise DatasetError.at(f"{where}: {camera}: {file}", f"{ends[-1]} frames, one for each row", got)
        frames = {part.index: slice(*ends[k : k + 2]) for k, part in enumerate(parts)}
        _check_times(file, camera, parts, packets, fps)
        return cls(file, packets, frames)

    def contents(self, index: int) -> Contents:
        """What the frames of an episode are made of."""
        return self.packets.contents(self.frames[index])

    def span(self, index: int, where: str, fps: float) -> Span:
        """Where the frames of an episode are."""
        times_s = self.packets.times_s[self.frames[index]]
        return Span(self.file, times_s, 0.5 / fps, where, _CONTAINER.get(self.file.suffix.lower()))


def _check_times(file: Path, camera: str, parts: Sequence[Part], packets: Packets, fps: float) -> None:
    rows_s = np.concatenate([part.times_s for part in parts])
    offsets_s = packets.times_s - rows_s
    tolerance_s = min(max(TOLERANCE_S, packets.tick_s), 0.25 / fps)
    if np.ptp(offsets_s) <= 2 * tolerance_s:  # one offset is within the tolerance of all
        return
    k = int(np.argmax(np.abs(offsets_s - offsets_s[0]) > tolerance_s))
    where = [f"{part.where}, row {t}" for part in parts for t in range(len(part.times_s))][k]
    rates = _rates(packets, fps)
    remedy = f"ffmpeg -r {fps:g} -i IN OUT gives it that rate" if rates else _AGAIN
    got = f"one at {packets.times_s[k]:.4f} s{rates}; {remedy}"
    raise DatasetError.at(f"{where}: {camera}: {file}", f"its frame at {rows_s[k] + offsets_s[0]:.4f} s", got)


def _rates(packets: Packets, fps: float) -> str:
    """What to add to a message where the film's rate is not the dataset's."""
    if not packets.fps or f"{packets.fps:.2f}" == f"{fps:.2f}":
        return ""
    return f" (the film has {packets.fps:.2f} frames a second, meta/info.json says {fps:g})"
