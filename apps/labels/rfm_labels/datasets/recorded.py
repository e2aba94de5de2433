# SPDX-License-Identifier: MIT
"""Datasets whose episodes may have different cameras. T frames, H x W pixels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rfm_client import RewardError, UInt8Array
from rfm_labels.datasets.dataset import CountedDataset, DatasetEpisode
from rfm_labels.datasets.faults import DatasetError, FaultsError, require
from rfm_labels.datasets.stored_files import Span, Times


class Stored(ABC):
    """One camera's frames in one episode."""

    @property
    @abstractmethod
    def count(self) -> int:
        """The number of frames, above 0. Raises DatasetError, also for what else is wrong without decoding."""

    @abstractmethod
    def identity(self) -> str:
        """Return a text that identifies the frames, as in ``Dataset.identity``."""

    @abstractmethod
    def frames(self) -> Iterator[UInt8Array]:
        """Yield the frames, as ``Dataset.stored_frames``."""

    def span(self) -> Span | None:
        """Return the frames in their video, as ``Dataset.span``."""
        return None

    @property
    def times_s(self) -> Times | None:
        """Times of the frames from the first, float64 [T]; None: unknown. Raises DatasetError."""
        return None

    @staticmethod
    def decoder() -> str | None:
        """Return the decoding library; None: pixels, or a reader decodes."""
        return None

    def doubt(self) -> str:
        """Return the same as ``Dataset.doubt`` for these frames."""
        return ""

    def check(self) -> None:  # noqa: B027 - ``count`` checks most kinds
        """Check what ``count`` has not. Raises DatasetError."""


@dataclass(frozen=True)
class Recorded:
    """An episode as it is stored.

    place, task_place: where its cameras and its task are, for messages
    task: None: unknown
    cameras: frames by camera
    missing: why it lacks other cameras
    faults: by picture, why it is no camera's frames
    """

    name: str
    place: str
    task: Any
    task_place: str
    cameras: Mapping[str, Stored]
    missing: str
    faults: Mapping[str, str] = field(default_factory=dict)

    def fault(self, picture: str) -> str:
        """Return why the episode lacks a camera; empty if it has it."""
        return "" if picture in self.cameras else self.faults.get(picture, self.missing)


class RecordedDataset(CountedDataset):
    """Episodes by number. Those cameras are scored that all chosen episodes have."""

    recorded: Mapping[int, Recorded]
    without_pictures = "none"  # what is there, and a remedy

    def set_recorded(self, recorded: Mapping[int, Recorded]) -> list[str]:
        """Set the episodes and their cameras, and return all cameras that some have. Raises DatasetError for none."""
        self.recorded, self.numbers = recorded, list(recorded)
        self._pictures = list(dict.fromkeys(each for one in recorded.values() for each in (*one.cameras, *one.faults)))
        self.cameras, self.left_out = self._shared(self.numbers)
        known = [each for each in self._pictures if any(each in one.cameras for one in recorded.values())]
        if not known:
            self.cameras_in(self.numbers)  # raises the reason
        return known

    def _shared(self, numbers: Sequence[int]) -> tuple[Sequence[str], Mapping[str, str]]:
        """The cameras that all these episodes share, and what is wrong with other pictures."""
        chosen = [self.recorded[number] for number in numbers]
        faults = {name: next(filter(None, (one.fault(name) for one in chosen)), "") for name in self._pictures}
        cameras = tuple(name for name, fault in faults.items() if not fault)
        return cameras, {name: fault for name, fault in faults.items() if fault}

    def cameras_in(self, numbers: Sequence[int]) -> tuple[Sequence[str], Mapping[str, str]]:
        cameras, left_out = self._shared(numbers)
        if cameras:
            return cameras, left_out
        lacking_it = [[number for number in numbers if self.recorded[number].fault(name)] for name in left_out]
        faulty = min(lacking_it, key=len, default=numbers)
        whole = len(faulty) == len(numbers)
        faults: dict[int, RewardError] = {}
        for number in numbers[:1] if whole else faulty:
            one = self.recorded[number]
            own = {name: fault for name in self._pictures if (fault := one.fault(name))}
            got = "; ".join(map(": ".join, (left_out if whole else own).items())) or self.without_pictures
            expected = "a camera as uint8 [T, H, W, 3]" + " in every episode" * whole
            faults[number] = DatasetError.at(one.place, expected, got)
        raise faults[numbers[0]] if whole else FaultsError.of(faults, numbers)

    def name_of(self, number: int) -> str:
        return self.recorded[number].name

    def length(self, number: int) -> int:
        return self._measured(number)[1]

    def _measured(self, number: int) -> tuple[Stored, int]:
        """The first camera that can be read, used ones first, and its count, which is the episode's."""
        fault: RewardError | None = None
        own = self.recorded[number].cameras
        unused = self.unused_cameras(list(own))
        for camera in sorted(own, key=lambda each: (each in unused, each not in self.cameras)):
            try:
                return own[camera], own[camera].count
            except RewardError as error:
                fault = fault or error
        self.cameras_in([number])  # raises the reason if there is no camera
        raise fault or AssertionError

    def read_episode(self, number: int) -> DatasetEpisode:
        one, length = self.recorded[number], self.length(number)
        task = self.given_task.of(one.task_place, one.task)
        return DatasetEpisode(number, one.name, task, length, self.frames_before(number))

    def times_s(self, episode: DatasetEpisode) -> Times | None:
        return self._measured(episode.index)[0].times_s if self.fps is None else None

    def decoder(self, camera: str) -> str | None:
        kinds = {type(one.cameras[camera]) for one in self.recorded.values() if camera in one.cameras}
        return ", ".join(sorted(filter(None, (kind.decoder() for kind in kinds)))) or None

    def identity(self, episode: DatasetEpisode, camera: str) -> str:
        return self.recorded[episode.index].cameras[camera].identity()

    def doubt(self, episode: DatasetEpisode, camera: str) -> str:
        return self.recorded[episode.index].cameras[camera].doubt()

    def check(self, episode: DatasetEpisode, camera: str) -> None:
        stored = self.recorded[episode.index].cameras[camera]
        got = f"{stored.count}: cut them alike, or leave the episode out (--episodes)"
        expected = f"{episode.num_frames} frames, as the other cameras"
        require(self.place(episode, camera), stored.count == episode.num_frames, expected, got)
        stored.check()

    def span(self, episode: DatasetEpisode, camera: str) -> Span | None:
        return self.recorded[episode.index].cameras[camera].span()

    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        return self.recorded[episode.index].cameras[camera].frames()
