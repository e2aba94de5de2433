# SPDX-License-Identifier: MIT
"""What a dataset gives: episodes with their tasks, and each camera's frames when they are asked for.

T frames of an episode, H x W pixels.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from rfm_client.contract import checks
from rfm_client.contract.errors import RewardError
from rfm_client.contract.samples import Trajectory, UInt8Array
from rfm_client.data.orientation import Orient, Orientation, turned

_CAMERA_PREFIX = "observation.images."


class DatasetError(RewardError, ValueError):
    """A dataset that contradicts itself or cannot be read, reported as ``where: expected X, got Y``."""

    @classmethod
    def at(cls, where: object, expected: str, got: object) -> DatasetError:
        """The error at a file, or at a place in it."""
        return cls(f"{where}: expected {expected}, got {got}")


def require(where: object, condition: bool, expected: str, got: object) -> None:
    """Raises DatasetError unless the condition holds."""
    checks.require(where, condition, expected, got, DatasetError)


@dataclass(frozen=True)
class DatasetEpisode:
    """One episode of a dataset.

    index: its number in the dataset
    name: what it is called there
    first_index: the dataset's number of its first frame; the others follow one by one
    """

    index: int
    name: str
    task: str
    num_frames: int
    first_index: int


class Dataset(ABC):
    """Episodes on disk. Opening one reads tables and no frames.

    kind: its layout, for example ``LeRobot v3.0``
    root: the folder in which labels are written unless the caller names another one
    source: its id on the Hub, or the name of its folder or file
    revision: the commit of the Hub; None: it is local
    cameras: their names, in the dataset's order
    depth_cameras: those whose pictures are distances, not colours: left out unless they are named
    left_out: pictures that cannot be scored and are none of ``cameras``, with the reason
    orientations: how ``frames`` turns the stored pictures of each camera that it turns
    notes: what the caller should know of its pictures before they are scored, a line each
    """

    kind: str
    root: Path
    source: str
    revision: str | None = None
    cameras: Sequence[str] = ()
    depth_cameras: Sequence[str] = ()
    left_out: Mapping[str, str] = {}
    orientations: Mapping[str, Orientation] = {}
    notes: Sequence[str] = ()

    @cached_property
    def episodes(self) -> Sequence[DatasetEpisode]:
        """All episodes, by index. Raises DatasetError."""
        return self.read_episodes()

    @abstractmethod
    def read_episodes(self) -> Sequence[DatasetEpisode]:
        """Reads and checks the tables of all episodes."""

    @abstractmethod
    def decoder(self, camera: str) -> str | None:
        """The library that decodes the camera's pictures, with its version; None: they are stored as pixels."""

    @abstractmethod
    def identity(self, episode: DatasetEpisode, camera: str, *, verify: bool) -> str:
        """What tells the episode's stored frames from others.

        Of a video its size and time of change, or with ``verify`` its SHA-256. Of pictures in a table, into which other
        programs write too, a digest of the pictures. Raises DatasetError.
        """

    @abstractmethod
    def check(self, episode: DatasetEpisode, camera: str) -> int:
        """Finds every frame of the episode without decoding one. Gives how many bytes they take as they are stored.

        Raises DatasetError for what contradicts itself, or is missing.
        """

    @abstractmethod
    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        """The T frames in order, uint8 [H, W, 3], RGB, each decoded once, as they are stored. Raises DatasetError."""

    def frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        """The T frames in order, uint8 [H, W, 3], RGB, turned as ``orientations`` says. Raises DatasetError."""
        orientation = self.orientations.get(camera, "none")
        return (turned(frame, orientation) for frame in self.stored_frames(episode, camera))


def chosen_cameras(dataset: Dataset, names: Iterable[str]) -> tuple[str, ...]:
    """The dataset's cameras of these names; none: all but depth cameras.

    A name may leave LeRobot's ``observation.images.`` out. Raises DatasetError for a camera that the dataset does not
    have, and if only depth cameras could be meant.
    """
    some = f"some of {', '.join(dataset.cameras)}"
    chosen = []
    for name in names:
        camera = _camera_named(name, dataset.cameras)
        if camera is None:
            reason = f", which is left out: {dataset.left_out[name]}" if name in dataset.left_out else ""
            raise DatasetError.at("cameras", some, f"{name!r}{reason}")
        chosen.append(camera)
    chosen = chosen or [camera for camera in dataset.cameras if camera not in dataset.depth_cameras]
    require("cameras", bool(chosen or not dataset.cameras), f"{some} named: all are depth cameras", "none")
    return tuple(chosen)


def orientations_of(
    orient: Orient, cameras: Sequence[str], defaults: Mapping[str, Orientation] | None = None
) -> Mapping[str, Orientation]:
    """The orientation of each camera that is turned. Raises DatasetError for a camera that is not there.

    defaults: of cameras that the caller does not speak of
    """
    asked: dict[str, Orientation] = dict(defaults or {})
    if orient.default is not None:
        asked = dict.fromkeys(cameras, orient.default)
    for name, orientation in orient.cameras.items():
        camera = _camera_named(name, cameras)
        if camera is None:
            raise DatasetError.at("orient", f"one of the cameras {', '.join(cameras)}", repr(name))
        asked[camera] = orientation
    return {camera: orientation for camera, orientation in asked.items() if orientation != "none"}


def _camera_named(name: str, cameras: Sequence[str]) -> str | None:
    return next((known for known in cameras if known in (name, _CAMERA_PREFIX + name)), None)


def iter_episodes(
    dataset: Dataset, cameras: Sequence[str] | None = None
) -> Iterator[tuple[DatasetEpisode, Mapping[str, Trajectory]]]:
    """Each episode with its trajectory as each camera filmed it, for loops of one's own. Raises DatasetError.

    cameras: some of the dataset's; None: all but depth cameras. The frames of one episode are in memory at a time.
    """
    names = chosen_cameras(dataset, cameras or ())
    for episode in dataset.episodes:
        for camera in names:
            dataset.check(episode, camera)
        videos = {camera: np.stack(list(dataset.frames(episode, camera))) for camera in names}
        yield episode, {camera: Trajectory(frames=video, task=episode.task) for camera, video in videos.items()}


def digest_of(parts: Iterable[bytes]) -> str:
    """A digest of these bytes, in which it matters where one part ends and the next begins."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


@dataclass(frozen=True)
class TaskOverride:
    """What the caller says of tasks. Raises DatasetError for an override without a text.

    text: of episodes that have none of their own; None: the caller does not say
    overrides: whether it is the task of all episodes
    """

    text: str | None = None
    overrides: bool = False

    def __post_init__(self) -> None:
        is_said = self.text is not None and bool(self.text.strip())
        got = "none" if self.text is None else repr(self.text)
        require("task", is_said or (self.text is None and not self.overrides), "a sentence", got)

    def of(self, where: object, own: object) -> str:
        """The task of an episode, whose own task may be missing. Raises DatasetError if neither is there."""
        is_missing = not own or (isinstance(own, str) and not own.strip())
        if self.text is not None and (self.overrides or is_missing):
            return self.text
        if is_missing or not isinstance(own, str):
            got = "none" if not own else repr(own)
            raise DatasetError.at(where, "a task as a sentence", f'{got}: add --task "what is to be done"')
        return own

    def check_used(self, episodes: Sequence[DatasetEpisode]) -> None:
        """Raises DatasetError if no episode has the task, since all have other ones."""
        is_used = self.text is None or any(episode.task == self.text for episode in episodes)
        got = f"{self.text!r}: leave it out, or put it in the place of theirs with --override-task"
        require("task", is_used, "none for episodes that all have tasks of their own", got)
