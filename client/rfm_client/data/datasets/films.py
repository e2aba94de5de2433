# SPDX-License-Identifier: MIT
"""Frames of a film at given times: found by their time stamps, each exactly once. Needs PyAV.

T times, N frames of the whole film. Seconds are those of the film, whose first frame need not be at 0.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client.contract.samples import UInt8Array
from rfm_client.data.datasets.protocol import DIGEST_BYTES, Contents, DatasetError, digest_of
from rfm_client.data.film_files import DAMAGED, UNDAMAGED, broken_off, judged, upright

Times = npt.NDArray[np.float64]

_FRAMES_BEFORE = 1  # to which a decoder is sent back: time stamps are rounded


@dataclass(frozen=True, eq=False)
class Span:
    """The frames of one episode in a film.

    times_s: float64 [T], rising; each frame's time stamp in the film
    tolerance_s: how far a time stamp may be off: half the time from one frame to the next
    where: names episode and camera in messages
    """

    file: Path
    times_s: Times
    tolerance_s: float
    where: str

    def error(self, expected: str, got: str) -> DatasetError:
        """The error of this span's film."""
        return DatasetError.at(f"{self.where}: {self.file}", expected, got)


@dataclass(frozen=True, eq=False)
class Packets:
    """What a film holds, read without decoding it.

    times_s: float64 [N], rising
    digests: of each frame's bytes, in the same order
    sizes: how many bytes each has
    """

    times_s: Times
    digests: tuple[bytes, ...]
    sizes: tuple[int, ...]

    @classmethod
    def read(cls, file: Path) -> Packets:
        """All packets of the film's first video stream. Raises DatasetError for a missing or truncated film."""
        av = import_av()
        found: list[tuple[float, bytes, int]] = []
        try:
            with file.open("rb") as opened:
                missing = broken_off(opened)
            if missing is not None:
                raise DatasetError.at(file, "a whole video file", missing)
            with av.open(str(file)) as container:
                if not container.streams.video:
                    raise DatasetError.at(file, "a video stream", "none")
                for packet in container.demux(video=0):
                    if packet.is_corrupt:
                        raise DatasetError.at(file, "a whole video file", f"one whose frame {len(found)} is broken")
                    if packet.size and packet.pts is not None:
                        digest = hashlib.blake2b(bytes(packet), digest_size=DIGEST_BYTES).digest()
                        found.append((float(packet.pts * packet.time_base), digest, packet.size))
        except FileNotFoundError as error:
            raise DatasetError.at(file, "a video file", "none") from error
        except (av.FFmpegError, OSError) as error:
            raise DatasetError.at(file, "a whole video file", error.strerror or str(error)) from error
        found.sort()
        times_s, digests, sizes = zip(*found, strict=True) if found else ((), (), ())
        return cls(np.array(times_s), digests, sizes)

    def check(self, span: Span) -> Contents:
        """What the span's frames are made of. Raises DatasetError if one is missing, or would have to stand for two."""
        if not len(self.times_s):
            raise span.error("frames", "none")
        after = np.clip(np.searchsorted(self.times_s, span.times_s), 1, max(len(self.times_s) - 1, 1))
        after = np.minimum(after, len(self.times_s) - 1)
        before = np.maximum(after - 1, 0)
        is_before = np.abs(self.times_s[before] - span.times_s) <= np.abs(self.times_s[after] - span.times_s)
        nearest = np.where(is_before, before, after)
        off_s = np.abs(self.times_s[nearest] - span.times_s)
        missing = np.flatnonzero(off_s > span.tolerance_s)
        if len(missing):
            t = int(missing[0])
            got = f"the nearest at {self.times_s[nearest[t]]:.4f} s ({len(self.times_s)} frames in the file)"
            raise span.error(f"frame {t} at {span.times_s[t]:.4f} s", got)
        twice = np.flatnonzero(np.diff(nearest) <= 0)
        if len(twice):
            raise span.error(f"a frame of its own at {span.times_s[twice[0] + 1]:.4f} s", "the one before it")
        picked = nearest.tolist()
        return Contents(digest_of(self.digests[index] for index in picked), sum(self.sizes[index] for index in picked))


def decode(span: Span) -> Iterator[UInt8Array]:
    """The T frames, uint8 [H, W, 3], upright, the nearest to each time. Raises DatasetError, also for a damaged one."""
    av = import_av()
    num_given = 0
    try:
        with av.open(str(span.file)) as container:
            for frame, is_damaged in _nearest(span, judged(_decoded(container, span))):
                if is_damaged:
                    raise DatasetError.at(f"{span.where}: {span.file}: frame {num_given}", UNDAMAGED, DAMAGED)
                yield upright(frame)
                num_given += 1
    except (av.FFmpegError, OSError) as error:
        raise span.error(f"frame {num_given} to be decoded", error.strerror or str(error)) from error
    if num_given != len(span.times_s):
        raise span.error(f"{len(span.times_s)} frames", f"{num_given}")


def import_av() -> Any:
    """The module ``av``. Raises ImportError that names the extra."""
    try:
        import av
    except ImportError as error:
        raise ImportError('video files need PyAV: pip install "./client[video]"') from error
    return av


def _decoded(container: Any, span: Span) -> Iterator[Any]:
    """Frames from before the span on, in the order of their times."""
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    first_s = float(span.times_s[0])
    container.seek(max(int((first_s - _FRAMES_BEFORE * 2 * span.tolerance_s) / stream.time_base), 0), stream=stream)
    frames = container.decode(stream)
    first = next(frames, None)
    if first is None or first.time > first_s + span.tolerance_s:  # the film's index has led too far
        container.seek(0, stream=stream)
        frames = container.decode(stream)
        first = next(frames, None)
    if first is not None:
        yield first
    yield from frames


def _nearest(span: Span, frames: Iterator[tuple[Any, bool]]) -> Iterator[tuple[Any, bool]]:
    """Of the judged frames the nearest to each time. Raises DatasetError if that is not within the tolerance."""
    t = 0
    held = next(frames, None)
    while held is not None and t < len(span.times_s):
        following = next(frames, None)
        target_s = float(span.times_s[t])
        held_s = held[0].time
        if following is None or abs(held_s - target_s) <= abs(following[0].time - target_s):
            if abs(held_s - target_s) > span.tolerance_s:
                raise span.error(f"frame {t} at {target_s:.4f} s", f"the nearest at {held_s:.4f} s")
            yield held
            t += 1
        held = following
