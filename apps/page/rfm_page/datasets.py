# SPDX-License-Identifier: MIT
"""LeRobot datasets for the page, in folders that the operator names, with or without labels. Needs pyarrow.

T frames of an episode.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt

from rfm_client import InvalidSampleError
from rfm_client.frames import video_stream
from rfm_client.options import ConfigError
from rfm_labels.datasets import (
    INFO_FILE,
    TASK_COLUMN,
    DatasetEpisode,
    DatasetError,
    Info,
    LeRobotDataset,
    Span,
    TaskOverride,
)
from rfm_page.links import check_links, links_in
from rfm_page.shown import ShownDataset

_AS_STORED = TaskOverride(column=TASK_COLUMN, is_needed=False)  # blank and outdated tasks are shown, too


@dataclass(frozen=True)
class ShownLeRobot(ShownDataset):
    """A LeRobot dataset for the page; an episode is cut out of the stored video."""

    has_stored_pixels = True

    dataset: LeRobotDataset

    @classmethod
    def open(cls, folder: str) -> ShownLeRobot:
        """Open the dataset in a folder. Raises ConfigError for any other folder, or links out of it."""
        try:
            import pyarrow  # noqa: F401
        except ImportError:
            got = "none: pip install ./client ./apps/labels"
            raise ConfigError.at("dataset", "pyarrow, which reads datasets", got) from None
        if not (Path(folder) / INFO_FILE).is_file():
            raise ConfigError.at("dataset", f"the folder of a LeRobot dataset ({INFO_FILE}), or an HDF5 file", folder)
        root = Path(folder).resolve()
        try:
            half_s = 0.5 / Info.read(root).fps  # a player shows the nearest frame, too
            shown = cls(root, root, LeRobotDataset(root, task=_AS_STORED, tolerance_s=half_s))
            shown.check()
            return shown
        except DatasetError as error:
            raise ConfigError(str(error), "dataset") from None

    def check(self) -> None:
        """Raise DatasetError for a link out of the folder."""
        check_links(self.root, links_in(self.root))

    @property
    def cameras(self) -> Sequence[str]:
        """The cameras with videos; pictures in tables are not shown."""
        return list(self.dataset.info.videos)

    @property
    def fps(self) -> float:
        """Frames a second, as ``meta/info.json`` says."""
        return self.dataset.info.fps

    def times_s(self, episode: DatasetEpisode) -> npt.NDArray[np.float64]:
        """Return float64 [T], the times of the episode's rows. Raises DatasetError."""
        return self.dataset.times_s(episode)

    def mp4(self, episode: DatasetEpisode, camera: str, take: Callable[[int], object]) -> bytes:
        """Return the episode's part of the stored video. Raises DatasetError."""
        return _cut(self.dataset.span(episode, camera), take)


def _cut(span: Span, take: Callable[[int], object]) -> bytes:
    """Return a span of a video as an MP4 file that begins at 0 s. Packets are copied, so frames stay equal.

    The file also holds earlier frames that decoding needs, marked so that players skip them.
    """
    clip = io.BytesIO()
    try:
        with av.open(
            str(span.file), format="mov"
        ) as video:  # without format=, FFmpeg would open the files in a play list
            stream = video_stream(video)
            packets = _packets(video, stream, span, take)
            zero = min(packet.pts for packet in packets if packet.pts * stream.time_base > _begin_s(span))
            with av.open(clip, "w", format="mp4") as copy:
                written = copy.add_stream_from_template(stream, opaque=True)  # no encoder is needed
                for packet in packets:
                    packet.pts -= zero
                    packet.dts -= zero
                    packet.stream = written
                    copy.mux(packet)
    except InvalidSampleError as error:
        raise DatasetError.like(error, where=f"{span.where}: {span.file}") from error
    except (av.FFmpegError, OSError) as error:
        raise span.error("a video of the episode", error.strerror or str(error)) from error
    return clip.getvalue()


def _begin_s(span: Span) -> float:
    return float(span.times_s[0]) - span.tolerance_s


def _packets(video: Any, stream: Any, span: Span, take: Callable[[int], object]) -> list[Any]:
    """Return the packets that decoding an episode needs, in the order of decoding."""
    begin_s, end_s = _begin_s(span), float(span.times_s[-1]) + span.tolerance_s
    video.seek(max(round(begin_s / stream.time_base), 0), stream=stream)
    packets: list[Any] = []
    for packet in video.demux(stream):
        if packet.pts is None or packet.dts is None:
            continue
        if packet.dts * stream.time_base > end_s:
            break
        take(packet.size)
        if packet.is_keyframe and packet.pts * stream.time_base <= begin_s + 1.5 * span.tolerance_s:
            packets = []  # decoding starts at this key frame
        packets.append(packet)
    shown_s = [float(packet.pts * stream.time_base) for packet in packets]
    while shown_s and shown_s[-1] > end_s:
        del packets[-1], shown_s[-1]
    num_shown = len(set(shown_s).intersection(span.times_s.tolist()))  # others between them belong to no row
    if num_shown != len(span.times_s) or not packets[0].is_keyframe:
        raise span.error(f"{len(span.times_s)} frames from {span.times_s[0]:.4f} s on", f"{num_shown}")
    if max(shown_s) > end_s:
        remedy = "encode it without frames that need later ones: ffmpeg -i IN -bf 0 OUT"
        raise span.error(
            f"an episode that can be cut out of its video ({remedy})", "one that needs frames behind its end"
        )
    return packets
