# SPDX-License-Identifier: MIT
"""What a dataset gives: episodes with their tasks, and each camera's frames when they are asked for.

T frames of an episode, H x W pixels.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from rfm_client.contract.errors import RewardError
from rfm_client.contract.samples import Trajectory, UInt8Array
from rfm_client.data.orientation import Orient, Orientation

DIGEST_BYTES = 16

_CAMERA_PREFIX = "observation.images."


class DatasetError(RewardError, ValueError):
    """A dataset that contradicts itself or cannot be read, reported as ``where: expected X, got Y``."""

    @classmethod
    def at(cls, where: object, expected: str, got: str) -> DatasetError:
        """The error at a file, or at a place in it."""
        return cls(f"{where}: expected {expected}, got {got}")


@dataclass(frozen=True)
class Episode:
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


@dataclass(frozen=True)
class Contents:
    """What an episode's frames are made of. num_bytes: as they are stored"""

    digest: str
    num_bytes: int


class Dataset(Protocol):
    """Episodes on disk. Opening one reads tables and no frames."""

    @property
    def kind(self) -> str:
        """Its layout, for example ``LeRobot v3.0``."""

    @property
    def root(self) -> Path:
        """The folder in which labels are written unless the caller names another one."""

    @property
    def source(self) -> str:
        """Its id on the Hub, or the name of its folder or file."""

    @property
    def revision(self) -> str | None:
        """The commit of the Hub; None: a local folder."""

    @property
    def cameras(self) -> Sequence[str]:
        """Names of the cameras, in the dataset's order."""

    @property
    def depth_cameras(self) -> Sequence[str]:
        """Those of the cameras whose pictures are distances, not colours: left out unless they are named."""

    @property
    def left_out(self) -> Mapping[str, str]:
        """Cameras that cannot be scored and are none of ``cameras``, with the reason."""

    @property
    def orientations(self) -> Mapping[str, Orientation]:
        """How ``frames`` turns the stored pictures of each camera that it turns."""

    @property
    def notes(self) -> Sequence[str]:
        """What the caller should know of its pictures before they are scored, a line each."""

    @property
    def episodes(self) -> Sequence[Episode]:
        """All episodes, by index."""

    def decoder(self, camera: str) -> str | None:
        """The library that decodes the camera's pictures, with its version; None: they are stored as pixels."""

    def check(self, episode: Episode, camera: str) -> Contents:
        """Finds every frame of the episode without decoding one. DatasetError for what contradicts itself, or is
        missing.
        """

    def frames(self, episode: Episode, camera: str) -> Iterator[UInt8Array]:
        """The T frames in order, uint8 [H, W, 3], RGB, each decoded once. Raises DatasetError for a frame that is not
        there or cannot be decoded.
        """


def chosen_cameras(dataset: Dataset, names: Iterable[str]) -> tuple[str, ...]:
    """The dataset's cameras of these names, which may leave LeRobot's ``observation.images.`` out; none: all but depth
    cameras.

    Raises DatasetError for a camera that the dataset does not have, and if only depth cameras could be meant.
    """
    chosen = []
    for name in names:
        camera = _camera_named(name, dataset.cameras)
        if camera is None:
            reason = f", which is left out: {dataset.left_out[name]}" if name in dataset.left_out else ""
            raise DatasetError.at("cameras", f"some of {', '.join(dataset.cameras)}", f"{name!r}{reason}")
        chosen.append(camera)
    chosen = chosen or [camera for camera in dataset.cameras if camera not in dataset.depth_cameras]
    if dataset.cameras and not chosen:
        raise DatasetError.at("cameras", f"some of {', '.join(dataset.cameras)} named: all are depth cameras", "none")
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
) -> Iterator[tuple[Episode, Mapping[str, Trajectory]]]:
    """Each episode with its trajectory as each camera filmed it, for loops of one's own. Raises DatasetError.

    cameras: some of the dataset's; None: all but depth cameras. The frames of one episode are in memory at a time.
    """
    names = chosen_cameras(dataset, cameras or ())
    for episode in dataset.episodes:
        for camera in names:
            dataset.check(episode, camera)
        yield (
            episode,
            {
                camera: Trajectory(frames=np.stack(list(dataset.frames(episode, camera))), task=episode.task)
                for camera in names
            },
        )


def contents_of(parts: Iterable[bytes]) -> Contents:
    """Digest and size of these bytes."""
    num_bytes = 0

    def counted() -> Iterator[bytes]:
        nonlocal num_bytes
        for part in parts:
            num_bytes += len(part)
            yield part

    return Contents(digest_of(counted()), num_bytes)


def digest_of(parts: Iterable[bytes]) -> str:
    """A digest of these bytes, in which it matters where one part ends and the next begins."""
    digest = hashlib.blake2b(digest_size=DIGEST_BYTES)
    for part in parts:
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


@dataclass(frozen=True)
class GivenTask:
    """What the caller says of tasks. Raises DatasetError for an override without a text.

    text: of episodes that have none of their own; None: the caller does not say
    overrides: whether it is the task of all episodes
    """

    text: str | None = None
    overrides: bool = False

    def __post_init__(self) -> None:
        is_said = self.text is not None and self.text.strip()
        if not is_said and (self.text is not None or self.overrides):
            raise DatasetError.at("task", "a sentence", "none" if self.text is None else repr(self.text))

    def of(self, where: object, own: object) -> str:
        """The task of an episode, whose own task may be missing. Raises DatasetError if neither is there."""
        is_missing = not own or (isinstance(own, str) and not own.strip())
        if self.text is not None and (self.overrides or is_missing):
            return self.text
        if is_missing or not isinstance(own, str):
            got = "none" if not own else repr(own)
            raise DatasetError.at(where, "a task as a sentence", f'{got}: add --task "what is to be done"')
        return own

    def check_used(self, episodes: Sequence[Episode]) -> None:
        """Raises DatasetError if no episode has the task, since all have other ones."""
        if self.text is not None and all(episode.task != self.text for episode in episodes):
            got = f"{self.text!r}: leave it out, or put it in the place of theirs with --override-task"
            raise DatasetError.at("task", "none for episodes that all have tasks of their own", got)
