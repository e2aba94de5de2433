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
from rfm_client.data.film_files import (
    DAMAGED,
    UNDAMAGED,
    FilmError,
    broken_off,
    film_packets,
    film_stream,
    import_av,
    judged,
    upright,
)

Times = npt.NDArray[np.float64]

_FRAMES_BEFORE = 1  # to which a decoder is sent back: time stamps are rounded


@dataclass(frozen=True, eq=False)
class Span:
    """The frames of one episode in a film.

    times_s: float64 [T], rising; each frame's time stamp in the film
    tolerance_s: half the time from one frame to the next
    where: names episode and camera in messages
    container: FFmpeg's name of the format that the file is read as; None: whatever it looks like
    """

    file: Path
    times_s: Times
    tolerance_s: float
    where: str
    container: str | None = None

    def error(self, expected: str, got: str) -> DatasetError:
        """The error of this span's film."""
        return DatasetError.at(f"{self.where}: {self.file}", expected, got)


@dataclass(frozen=True, eq=False)
class Packets:
    """What a film holds, read without decoding it.

    times_s: float64 [N], rising
    digests: of each frame's bytes, in the same order
    sizes: how many bytes each has
    tick_s: what times are multiples of
    fps: frames a second on average; 0: the file does not say it
    """

    times_s: Times
    digests: tuple[bytes, ...]
    sizes: tuple[int, ...]
    tick_s: float
    fps: float

    @classmethod
    def read(cls, file: Path, container: str | None = None) -> Packets:
        """The packets of all frames. Raises DatasetError for a missing or truncated file, and one of several films."""
        av = import_av()
        found: list[tuple[float, bytes, int]] = []
        try:
            with file.open("rb") as opened:
                missing = broken_off(opened)
            if missing is not None:
                raise DatasetError.at(file, "a whole video file", missing)
            with av.open(str(file), format=container) as film:
                stream = film_stream(film)
                for packet in film_packets(film, stream):
                    if packet.is_corrupt:
                        raise DatasetError.at(file, "a whole video file", f"one whose frame {len(found)} is broken")
                    if packet.pts is not None:
                        digest = hashlib.blake2b(bytes(packet), digest_size=DIGEST_BYTES).digest()
                        found.append((float(packet.pts * packet.time_base), digest, packet.size))
                tick_s, fps = float(stream.time_base), float(stream.average_rate or 0)
        except FilmError as error:
            raise DatasetError.at(file, error.expected, error.got) from error
        except FileNotFoundError as error:
            raise DatasetError.at(file, "a video file", "none") from error
        except (av.FFmpegError, OSError) as error:
            raise DatasetError.at(file, "a whole video file", error.strerror or str(error)) from error
        found.sort()
        times_s, digests, sizes = zip(*found, strict=True) if found else ((), (), ())
        return cls(np.array(times_s), digests, sizes, tick_s, fps)

    def contents(self, frames: slice = slice(None)) -> Contents:
        """What these frames are made of."""
        return Contents(digest_of(self.digests[frames]), sum(self.sizes[frames]))


def decode(span: Span) -> Iterator[UInt8Array]:
    """The T frames, uint8 [H, W, 3], upright. Raises DatasetError for a frame that is not there, or damaged."""
    av = import_av()
    num_given = 0
    try:
        with av.open(str(span.file), format=span.container) as container:
            for frame, is_damaged in _within(span, judged(_decoded(container, span))):
                if is_damaged:
                    raise DatasetError.at(f"{span.where}: {span.file}: frame {num_given}", UNDAMAGED, DAMAGED)
                yield upright(frame)
                num_given += 1
    except FilmError as error:
        raise span.error(error.expected, error.got) from error
    except (av.FFmpegError, OSError) as error:
        raise span.error(f"frame {num_given} to be decoded", error.strerror or str(error)) from error
    if num_given != len(span.times_s):
        raise span.error(f"{len(span.times_s)} frames", f"{num_given}")


def _decoded(container: Any, span: Span) -> Iterator[Any]:
    """Frames from before the span on, in the order of their times."""
    stream = film_stream(container)
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


def _within(span: Span, frames: Iterator[tuple[Any, bool]]) -> Iterator[tuple[Any, bool]]:
    """Of the judged frames those of the span. Raises DatasetError for one that is missing among them."""
    for t, time_s in enumerate(span.times_s.tolist()):
        found = next((each for each in frames if each[0].time > time_s - span.tolerance_s), None)
        if found is None or found[0].time > time_s + span.tolerance_s:
            got = "none" if found is None else f"the next at {found[0].time:.4f} s"
            raise span.error(f"frame {t} at {time_s:.4f} s", got)
        yield found
