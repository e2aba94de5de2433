# SPDX-License-Identifier: MIT
"""LeRobot datasets of all versions, without LeRobot: frame t is the dataset's frame t. Needs pyarrow, and PyAV.

A film has as many frames as the rows of its episodes, at the same times (``lerobot_films``), or it is refused.
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
from rfm_client.data.datasets.films import Span, Times, decode
from rfm_client.data.datasets.lerobot_films import Film, Part
from rfm_client.data.datasets.lerobot_info import Info
from rfm_client.data.datasets.lerobot_rows import Entry, RowReader, read_table
from rfm_client.data.datasets.protocol import Contents, DatasetError, Episode, GivenTask, contents_of, orientations_of
from rfm_client.data.film_files import decoder
from rfm_client.data.orientation import Orient, turned

FILMS_AT_A_TIME = 4  # whose tables of packets are kept in memory

_COLOURS = ("1", "L", "LA", "P", "RGB", "RGBA")  # Pillow's names of what has 8 bits a channel, or fewer
_DEEP = ";16"  # how Pillow names 16 bits a channel that it cuts to 8


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
        self._film = lru_cache(FILMS_AT_A_TIME)(self._read_film)
        version = lerobot_v30 if self.info.version == "v3.0" else lerobot_v21
        entries: Iterator[Entry] = version.read_entries(root, self.info)
        self._entries = {entry.index: entry for entry in entries}
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
            return self._film(camera, self.film(episode, camera)).contents(episode.index)
        images = self._images(episode, camera)
        for t, image in enumerate(images):
            _opened_image(self._where(episode, camera, t), image)
        return contents_of(images)

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

    def film(self, episode: Episode, camera: str) -> Path:
        """The film of a camera, one of ``info.films``, that the episode is in."""
        return self._entries[episode.index].films[camera][0]

    def span(self, episode: Episode, camera: str) -> Span:
        """Where the episode's frames are in that film. Raises DatasetError if its frames and rows differ."""
        film = self._film(camera, self.film(episode, camera))
        return film.span(episode.index, f"{episode.name}: {camera}", self.info.fps)

    def files(self) -> set[Path]:
        """The tables and films that the episodes are in."""
        entries = self._entries.values()
        return {entry.data_file for entry in entries} | {film for entry in entries for film, _ in entry.films.values()}

    def decoder(self, camera: str) -> str | None:
        """PyAV or Pillow, with the versions that decide what a picture looks like."""
        return decoder() if camera in self.info.films else _pillow()

    @cached_property
    def _in_film(self) -> Mapping[tuple[str, Path], Sequence[Entry]]:
        """The episodes in each film of each camera."""
        found: dict[tuple[str, Path], list[Entry]] = {}
        for entry in self._entries.values():
            for camera, (file, _) in entry.films.items():
                found.setdefault((camera, file), []).append(entry)
        return found

    def _read_film(self, camera: str, file: Path) -> Film:
        parts = [
            Part(entry.index, entry.where, entry.films[camera][1] + self._rows.read(entry).times_s)
            for entry in self._in_film[camera, file]
        ]
        return Film.read(file, camera, parts, self.info.fps)

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
    with _opened_image(where, image) as opened:
        try:
            return np.asarray(opened.convert("RGB"))
        except OSError as error:
            raise DatasetError.at(where, "an image", str(error)) from error


def _opened_image(where: str, image: bytes) -> Any:
    """A picture of which only the head is read. Raises DatasetError for what is none of 8-bit colours."""
    _pillow()
    from PIL import Image, UnidentifiedImageError

    try:
        opened = Image.open(io.BytesIO(image))
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise DatasetError.at(where, "an image", str(error)) from error
    is_deep = _DEEP in str(opened.tile)
    if opened.mode not in _COLOURS or is_deep:
        expected = "a picture of 8-bit colours (convert it, or leave a depth camera out: --cameras)"
        raise DatasetError.at(where, expected, f"{opened.format} of {'16-bit ' * is_deep}{opened.mode}")
    return opened


def _pillow() -> str:
    """Pillow with its version. Raises ImportError that names the extra."""
    try:
        import PIL
    except ImportError as error:
        raise ImportError('datasets of images need Pillow: pip install "./client[label]"') from error
    return f"Pillow {PIL.__version__}"
