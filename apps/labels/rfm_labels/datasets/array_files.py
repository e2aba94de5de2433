# SPDX-License-Identifier: MIT
"""A folder of ``.npy`` or ``.npz`` files with the frames of an episode each, as ``load_trajectory`` reads them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from rfm_client import InvalidSampleError, Trajectory, UInt8Array
from rfm_client.frames import load_trajectory
from rfm_labels.datasets.episode_files import Contents, EpisodeFiles
from rfm_labels.datasets.protocol import DatasetEpisode, DatasetError, require
from rfm_labels.datasets.video_frames import video_identity


class ArrayFiles(EpisodeFiles):
    """Episodes in files of arrays. A ``.npz`` file may hold its task."""

    kind = "arrays"
    cameras = ("frames",)

    def __init__(self, contents: Contents) -> None:
        super().__init__(contents)
        self._facts = lru_cache(None)(_facts)

    def length(self, file: Path) -> int:
        return self._facts(file)[0]

    def own_task(self, file: Path) -> str | None:
        return self._facts(file)[1]

    def decoder(self, camera: str) -> str | None:
        return None

    def identity(self, episode: DatasetEpisode, camera: str, *, verify: bool) -> str:
        return video_identity(self.root / episode.name, verify=verify)

    def check(self, episode: DatasetEpisode, camera: str) -> int:
        file = self.root / episode.name
        frames = _frames(file)
        require(file, len(frames) == episode.num_frames, f"{episode.num_frames} frames", len(frames))
        return int(frames.nbytes)

    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        return iter(_frames(self.root / episode.name))


def _facts(file: Path) -> tuple[int, str | None]:
    """The number of frames, and the task. The file is read whole: only all its values tell if they are frames."""
    trajectory = _read(file)
    return trajectory.num_frames, trajectory.task or None


def _frames(file: Path) -> UInt8Array:
    frames = _read(file).frames
    assert frames is not None  # ``_read`` refuses embeddings
    return frames


def _read(file: Path) -> Trajectory:
    """The frames and the task in a file. Raises DatasetError, also for embeddings."""
    try:
        trajectory = load_trajectory(file)
    except InvalidSampleError as error:
        raise DatasetError(f"{file}: {error}") from error
    got = "embeddings: score them with rfm-client score"
    require(file, trajectory.frames is not None, "frames, uint8 [T, H, W, 3]", got)
    return trajectory
