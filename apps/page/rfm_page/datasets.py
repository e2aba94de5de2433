# SPDX-License-Identifier: MIT
"""LeRobot and HDF5 datasets for the page, with or without labels. Needs pyarrow, and h5py for HDF5.

T frames per episode.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import av

from rfm_client import UInt8Array
from rfm_client.frames import FrameFileError, Video
from rfm_labels import DatasetEpisode, DatasetError, find_label_files
from rfm_labels.datasets import Hdf5Dataset, LeRobotDataset, Span, opened_hdf5
from rfm_page.shown import ShownDataset, check_links

_FILES_KNOWN = 64  # HDF5 files whose last check is remembered


@dataclass(frozen=True)
class ShownLeRobot(ShownDataset):
    """A LeRobot dataset for the page. Episodes are cut out of stored videos; pictures in tables are encoded."""

    dataset: LeRobotDataset

    @property
    def has_stored_pixels(self) -> bool:
        """True if all cameras have videos."""
        return not self.dataset.info.images

    @property
    def cameras(self) -> Sequence[str]:
        """The cameras with videos, and those with colour pictures."""
        unused, videos = self.dataset.unused_cameras(self.dataset.cameras), self.dataset.info.videos
        return [camera for camera in self.dataset.cameras if camera in videos or camera not in unused]

    def ends(self, episode: DatasetEpisode, camera: str) -> list[UInt8Array]:
        """Return the first and the last frame of the stored video, or the first picture. Raises DatasetError."""
        if camera not in self.dataset.info.videos:
            return super().ends(episode, camera)
        span = self.dataset.span(episode, camera)
        return [frame for t in (0, -1) for frame in replace(span, times_s=span.times_s[[t]]).frames()]

    def mp4(self, episode: DatasetEpisode, camera: str, take: Callable[[int], object]) -> bytes:
        """Return the episode's part of the stored video, or its pictures as a video. Raises DatasetError."""
        if camera not in self.dataset.info.videos:
            return super().mp4(episode, camera, take)
        return _cut(self.dataset.span(episode, camera), take)


def _cut(span: Span, take: Callable[[int], object]) -> bytes:
    """Return a span of a video as an MP4 file that begins at 0 s. Packets are copied, so frames stay identical.

    The file also holds earlier frames that decoding needs, marked so that players skip them.
    """
    clip = io.BytesIO()
    try:
        with Video(span.video.file, "mov").opened() as (video, stream):  # another format may name other files
            packets = _packets(video, stream, span, take)
            zero = min(packet.pts for packet in packets if packet.pts * stream.time_base > _begin_s(span))
            with av.open(clip, "w", format="mp4") as copy:
                written = copy.add_stream_from_template(stream, opaque=True)  # no encoder is needed
                for packet in packets:
                    packet.pts -= zero
                    packet.dts -= zero
                    packet.stream = written
                    copy.mux(packet)
    except FrameFileError as error:
        raise span.error(error.expected, error.got) from error
    except (av.FFmpegError, OSError) as error:
        raise span.error("a video of the episode", error.strerror or str(error)) from error
    return clip.getvalue()


def _begin_s(span: Span) -> float:
    return float(span.times_s[0]) - span.tolerance_s


def _packets(video: Any, stream: Any, span: Span, take: Callable[[int], object]) -> list[Any]:
    """Return the packets needed to decode an episode, in decoding order."""
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
    num_shown = len(set(shown_s).intersection(span.times_s.tolist()))  # other frames between them belong to no row
    if num_shown != len(span.times_s) or not packets[0].is_keyframe:
        raise span.error(f"{len(span.times_s)} frames from {span.times_s[0]:.4f} s on", f"{num_shown}")
    if max(shown_s) > end_s:
        remedy = "encode it without frames that need later ones: ffmpeg -i IN -bf 0 OUT"
        raise span.error(
            f"an episode that can be cut out of its video ({remedy})", "one that needs frames behind its end"
        )
    return packets


@dataclass(frozen=True)
class ShownHdf5(ShownDataset):
    """An HDF5 dataset for the page.

    Refuses a file that links to other files or stores data in them: its author could show files from this
    machine.
    """

    dataset: Hdf5Dataset

    @property
    def path(self) -> Path:
        """The single file that holds the dataset."""
        return self.dataset.file

    def check(self) -> None:
        """Raise DatasetError if the dataset or its labels keep data in other files."""
        check_links(self.root, [self.path, *find_label_files(self.path)])
        _check_inside(self.path, _changed_ns(self.path))

    @property
    def cameras(self) -> Sequence[str]:
        """The cameras that are labelled by default."""
        return self.dataset.chosen_cameras()


def _changed_ns(file: Path) -> int:
    """Return when a file last changed, a time that its author cannot set. Raises DatasetError."""
    try:
        return file.stat().st_ctime_ns
    except OSError as error:
        raise DatasetError.at(file, "an HDF5 file", error.strerror) from error


@lru_cache(_FILES_KNOWN)
def _check_inside(file: Path, _changed_ns: int) -> None:
    """Raise DatasetError for data in another file."""
    import h5py

    def leaves(name: str, link: Any) -> str | None:
        if isinstance(link, h5py.ExternalLink):
            return name
        found = opened.get(name) if isinstance(link, h5py.HardLink) else None
        is_outside = isinstance(found, h5py.Dataset) and (found.external or found.is_virtual)
        return name if is_outside else None

    with opened_hdf5(file) as opened:
        name = opened.visititems_links(leaves)
    if name is not None:
        raise DatasetError.at(f"{file}: {name}", "data in the file", "data in another file: copy them into it")
