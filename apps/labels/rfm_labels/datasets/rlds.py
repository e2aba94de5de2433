# SPDX-License-Identifier: MIT
"""RLDS datasets, such as Open X-Embodiment, read without TensorFlow. Needs ``rfm-labels[rlds]`` and Pillow.

An episode is one record in a TFRecord file. Splits follow each other and serve as filter keys. Frames are JPEG or PNG
files in ``steps/observation/<camera>``; the task is an instruction in the steps or in the episode.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfm_client import RewardError, UInt8Array
from rfm_client.frames import BlankFrames, FrameFileError, Picture
from rfm_client.options import is_blank
from rfm_labels.datasets.dataset import AskedCorrections, CountedDataset, DatasetEpisode, TaskOverride
from rfm_labels.datasets.faults import DatasetError, require
from rfm_labels.datasets.rlds_files import (
    FEATURES_FILE,
    INSTRUCTIONS,
    RecordFile,
    RldsInfo,
    check_packages,
    features_of,
)
from rfm_labels.datasets.stored_files import check_pictures, digest_of, picture_frames


def rlds_folder(path: Path) -> Path | None:
    """Return an RLDS dataset's folder: ``path``, or its only version; None: no RLDS dataset. Raises DatasetError."""
    if not path.is_dir() or (path / FEATURES_FILE).is_file():
        return path if path.is_dir() else None
    versions = sorted(file.parent for file in path.glob(f"*/{FEATURES_FILE}"))
    got = f"{', '.join(each.name for each in versions)}: name one of these folders"
    require(path, len(versions) < 2, "one version of an RLDS dataset", got)
    return versions[0] if versions else None


@dataclass(frozen=True)
class _Pictures:
    """One camera's pictures in an episode.

    blank: what they show, if all are one black or flat picture; else empty
    fault: the first broken picture's error
    """

    digest: str
    blank: str
    fault: DatasetError | None


@dataclass(frozen=True)
class _Record:
    """What the dataset caches from a record.

    instruction: the feature that holds the texts
    texts: (first step, instruction) for each stretch with one instruction
    """

    num_steps: int
    instruction: str
    texts: Sequence[tuple[int, bytes]]
    pictures: Mapping[str, _Pictures]


class RldsDataset(CountedDataset):
    """The episodes in all splits."""

    kind = "RLDS"

    def __init__(
        self, root: Path, *, task: TaskOverride = TaskOverride(), corrections: AskedCorrections = AskedCorrections()
    ) -> None:
        check_packages()
        self.root = root
        self._info = info = RldsInfo.read(root, task.column)
        self.source, self.given_task, self.notes = info.source, task, info.notes
        self.cameras, self.left_out = tuple(info.cameras), info.left_out
        self.corrections = corrections.of_cameras(self.cameras)
        self._places: list[tuple[RecordFile, int]] = []
        self.filter_keys = keys = {split: list[int]() for split, _ in info.files}
        for split, file in info.files:
            keys[split] += range(len(self._places), len(self._places) + file.num_records)
            self._places += [(file, number) for number in range(file.num_records)]
        self.numbers = range(len(self._places))
        self._records: dict[int, _Record] = {}

    def length(self, number: int) -> int:
        return self._record(number).num_steps

    def read_episode(self, number: int) -> DatasetEpisode:
        (file, record), length = self._places[number], self.length(number)
        stretches = self._tasks(number, self._record(number))
        several = tuple(stretches) if len(stretches) > 1 else ()
        name, first = f"{file.file.name}#{record}", self.frames_before(number)
        return DatasetEpisode(number, name, stretches[0][1], length, first, several)

    def cameras_in(self, numbers: Sequence[int]) -> tuple[Sequence[str], Mapping[str, str]]:
        readable = []
        for number in numbers:
            with suppress(RewardError):  # raised again if this episode is read
                readable.append(self._record(number))
        blank: dict[str, str] = {}
        for camera in self.cameras if readable else ():
            descriptions = [record.pictures[camera].blank for record in readable]
            if all(descriptions):
                blank[camera] = f"{descriptions[0]} in every chosen episode"
        cameras = [camera for camera in self.cameras if camera not in blank]
        require(self.root, bool(cameras), "a camera that shows something", "; ".join(map(": ".join, blank.items())))
        return cameras, {**self.left_out, **blank}

    def decoder(self, camera: str) -> str | None:
        return Picture.decoder()

    def identity(self, episode: DatasetEpisode, camera: str) -> str:
        return self._record(episode.index).pictures[camera].digest

    def check(self, episode: DatasetEpisode, camera: str) -> None:
        fault = self._record(episode.index).pictures[camera].fault
        if fault is not None:
            raise fault

    def place(self, episode: DatasetEpisode, camera: str) -> str:
        return f"{self._where(episode.index)}: {camera}"

    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        stored = self._values(self._features(episode.index), self._info.cameras[camera])
        return picture_frames(stored, self.place(episode, camera))

    def _record(self, number: int) -> _Record:
        """Read a record, cached after the first call. Raises DatasetError."""
        if number not in self._records:
            features, where = self._features(number), self._where(number)
            stored = {camera: self._values(features, name) for camera, name in self._info.cameras.items()}
            instruction = self._instruction(features)
            texts = self._values(features, instruction)
            num_steps = len(stored[self.cameras[0]])
            counts = {name: len(each) for name, each in stored.items()}
            if instruction.startswith("steps/"):
                counts[instruction] = len(texts)
            lengths = ", ".join(f"{name} {count}" for name, count in counts.items())
            require(where, num_steps > 0 and len({*counts.values()}) == 1, "one number of steps, above 0", lengths)
            pictures = {camera: _pictures(f"{where}: {camera}", each) for camera, each in stored.items()}
            changes = [(t, text) for t, text in enumerate(texts) if t == 0 or text != texts[t - 1]]
            self._records[number] = _Record(num_steps, instruction, changes, pictures)
        return self._records[number]

    def _instruction(self, features: Mapping[str, Any]) -> str:
        """The first feature with a non-blank instruction; else the first feature, or none."""
        known = self._info.instructions
        filled = (name for name in known if any(not is_blank(_shown(text)) for text in self._values(features, name)))
        return next(filled, known[0] if known else "")

    def _tasks(self, number: int, record: _Record) -> list[tuple[int, str]]:
        """First frame and task for each stretch with one task. Raises DatasetError."""
        where = f"{self._where(number)}: {record.instruction or ' or '.join(INSTRUCTIONS)}"
        texts = record.texts if record.texts and not self.given_task.overrides else [(0, b"")]
        texts = texts[:1] if self.given_task.several == "first" else texts
        return [(t, self.given_task.of(where, _decoded(where, text))) for t, text in texts]

    def _features(self, number: int) -> Mapping[str, Any]:
        file, record = self._places[number]
        return features_of(file.record(record), self._where(number))

    @staticmethod
    def _values(features: Mapping[str, Any], name: str) -> Sequence[bytes]:
        return features[name].bytes_list.value if name in features else ()

    def _where(self, number: int) -> str:
        file, record = self._places[number]
        return f"{file.file}: record {record}"


def _pictures(where: str, stored: Sequence[bytes]) -> _Pictures:
    digest, blank = digest_of(stored), ""
    try:
        check_pictures(stored, where)
    except DatasetError as fault:
        return _Pictures(digest, blank, fault)
    if all(picture == stored[0] for picture in stored):
        with suppress(FrameFileError):  # raised again by the frames
            blank = BlankFrames([Picture(stored[0]).pixels()]).told
    return _Pictures(digest, blank, None)


def _shown(text: bytes) -> str:
    return text.decode(errors="replace")


def _decoded(where: str, text: bytes) -> str:
    try:
        return text.decode()
    except UnicodeDecodeError as error:
        raise DatasetError.at(where, "a task in UTF-8", error) from error
