# SPDX-License-Identifier: MIT
"""LeRobot datasets of all versions, without LeRobot: frame t is the dataset's frame t. Needs pyarrow, and PyAV.

A frame in a film is found by its time stamp: where the episode begins in the film, plus the row's own.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from rfm_client.contract.samples import UInt8Array
from rfm_client.data.datasets import lerobot_v21, lerobot_v30
from rfm_client.data.datasets.films import Packets, Span, Times, decode
from rfm_client.data.datasets.lerobot_info import Info
from rfm_client.data.datasets.lerobot_rows import Entry, RowReader, read_table
from rfm_client.data.datasets.protocol import Contents, DatasetError, Episode, GivenTask, contents_of, orientations_of
from rfm_client.data.orientation import Orient, turned

FILMS_AT_A_TIME = 4  # whose tables of packets are kept in memory


class LeRobotDataset:
    """A LeRobot dataset in a local folder.

    source, revision: of the Hub, if it came from there
    task: what the caller says of tasks
    orient: how pictures are turned
    """

    left_out: Mapping[str, str] = {}
    notes: Sequence[str] = ()

    def __init__(
        self,
        root: Path,
        *,
        source: str | None = None,
        revision: str | None = None,
        task: GivenTask = GivenTask(),
        orient: Orient = Orient(),
    ) -> None:
        self.root = root
        self.source = source or root.resolve().name
        self.revision = revision
        self.info = Info.read(root)
        self._packets = lru_cache(FILMS_AT_A_TIME)(Packets.read)
        version = lerobot_v30 if self.info.version == "v3.0" else lerobot_v21
        self._entries = {entry.index: entry for entry in version.read_entries(root, self.info)}
        self._task = task
        self._rows = RowReader({} if task.overrides else version.read_tasks(root), task)
        self.orientations = orientations_of(orient, self.cameras)
        self._check_totals()

    @property
    def kind(self) -> str:
        """Its layout, with the version."""
        return f"LeRobot {self.info.version}"

    @property
    def cameras(self) -> Sequence[str]:
        """Keys of the features that are video or images."""
        return (*self.info.films, *self.info.images)

    @property
    def depth_cameras(self) -> Sequence[str]:
        """Those whose pictures are depth maps."""
        return self.info.depth

    @cached_property
    def episodes(self) -> Sequence[Episode]:
        """All episodes. Reads and checks the rows of all of them; raises DatasetError."""
        episodes = [self._episode(entry) for _, entry in sorted(self._entries.items())]
        self._task.check_used(episodes)
        return episodes

    def check(self, episode: Episode, camera: str) -> Contents:
        """What the episode's frames are made of; each is there. Raises DatasetError."""
        if camera in self.info.films:
            span = self.span(episode, camera)
            return self._packets(span.file).check(span)
        return contents_of(self._images(episode, camera))

    def frames(self, episode: Episode, camera: str) -> Iterator[UInt8Array]:
        """The episode's frames, uint8 [H, W, 3], turned as ``orientations`` says. Raises DatasetError."""
        orientation = self.orientations.get(camera, "none")
        return (turned(frame, orientation) for frame in self._stored(episode, camera))

    def _stored(self, episode: Episode, camera: str) -> Iterator[UInt8Array]:
        if camera in self.info.films:
            return decode(self.span(episode, camera))
        images = self._images(episode, camera)
        return (_decoded_image(self._where(episode, camera, t), image) for t, image in enumerate(images))

    def times_s(self, episode: Episode) -> Times:
        """float64 [T], when each frame was taken, from the start of the episode. Raises DatasetError."""
        return self._rows.read(self._entries[episode.index]).times_s

    def span(self, episode: Episode, camera: str) -> Span:
        """Where the episode's frames are in the film of a camera, one of ``info.films``. Raises DatasetError."""
        entry = self._entries[episode.index]
        file, from_s = entry.films[camera]
        return Span(file, from_s + self.times_s(episode), 0.5 / self.info.fps, f"{entry.where}: {camera}")

    def files(self) -> set[Path]:
        """The tables and films that the episodes are in."""
        entries = self._entries.values()
        return {entry.data_file for entry in entries} | {film for entry in entries for film, _ in entry.films.values()}

    def _episode(self, entry: Entry) -> Episode:
        rows = self._rows.read(entry)
        return Episode(entry.index, entry.where, rows.task, len(rows.times_s), rows.first_index)

    def _images(self, episode: Episode, camera: str) -> list[bytes]:
        """The episode's images as they are stored: encoded as PNG or JPEG."""
        file = self._entries[episode.index].data_file
        stored = read_table(file, [camera], filters=[("episode_index", "=", episode.index)])[camera].to_pylist()
        if len(stored) != episode.num_frames:
            raise DatasetError.at(f"{file}: {camera}", f"{episode.num_frames} images", str(len(stored)))
        return [self._image_bytes(self._where(episode, camera, t), image) for t, image in enumerate(stored)]

    def _image_bytes(self, where: str, image: Any) -> bytes:
        image = image if isinstance(image, dict) else {}
        if isinstance(image.get("bytes"), bytes):
            return bytes(image["bytes"])
        path = image.get("path")
        if not isinstance(path, str) or Path(path).is_absolute() or ".." in Path(path).parts:
            raise DatasetError.at(where, "an image, or its path inside the dataset", repr(path))
        try:
            return (self.root / path).read_bytes()
        except OSError as error:
            raise DatasetError.at(where, "an image file", f"{error.strerror} ({path})") from error

    def _where(self, episode: Episode, camera: str, t: int) -> str:
        return f"{episode.name}: {camera}: frame {t}"

    def _check_totals(self) -> None:
        where, info = self.root / "meta", self.info
        if len(self._entries) != info.total_episodes or sorted(self._entries) != list(range(info.total_episodes)):
            raise DatasetError.at(where, f"{info.total_episodes} episodes, as info.json says", str(len(self._entries)))
        num_frames = sum(entry.length for entry in self._entries.values())
        if num_frames != info.total_frames:
            raise DatasetError.at(where, f"{info.total_frames} frames, as info.json says", str(num_frames))


def _decoded_image(where: str, image: bytes) -> UInt8Array:
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError as error:
        raise ImportError('datasets of images need Pillow: pip install "./client[label]"') from error
    try:
        with Image.open(io.BytesIO(image)) as opened:
            return np.asarray(opened.convert("RGB"))
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise DatasetError.at(where, "an image", str(error)) from error
