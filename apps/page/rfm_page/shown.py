# SPDX-License-Identifier: MIT
"""A dataset of any kind for the page: its episodes and their labels.

Needs pyarrow. T frames per episode.
"""

from __future__ import annotations

import base64
import io
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np
import numpy.typing as npt
from fastapi import HTTPException
from PIL import Image

from rfm_client import ModelInfo, UInt8Array
from rfm_client.episodes import SuccessRule
from rfm_client.frames import ChannelOrder, Correction, Orientation
from rfm_labels import (
    Curve,
    Dataset,
    DatasetEpisode,
    DatasetError,
    EpisodeLabels,
    Summary,
    find_label_files,
    read_episode_labels,
    read_provenance,
    summarise,
)
from rfm_page.clips import cut, encoded, is_playable

Read = TypeVar("Read")

_SUMMARIES_AT_A_TIME = 8  # summaries in memory
_POINTS = 32  # in a preview's curve
_PREVIEW_PX = (96, 72)  # maximum width and height


@dataclass(frozen=True)
class ShownDataset:
    """A dataset for the page. Stored videos are cut; other frames are encoded as videos.

    dataset: as ``open_to_show`` returns it
    Methods raise DatasetError for a broken dataset, HTTPException 404 for a missing episode, camera or label file, 409
    for an episode that must be downloaded first.
    """

    dataset: Dataset

    @property
    def root(self) -> Path:
        """The folder, with links resolved."""
        return self.dataset.root

    @property
    def path(self) -> Path:
        """The folder or file."""
        return self.root

    def check(self) -> None:
        """Raise DatasetError if the dataset would show other files from this machine. Called before every read."""
        if self.dataset.revision is None:  # else all links are those that huggingface_hub made in its cache
            check_links(self.root, links_in(self.root))

    @property
    def cameras(self) -> Sequence[str]:
        """The cameras whose videos the page shows."""
        return self.dataset.cameras

    @property
    def fps(self) -> float:
        """Video frames per second, 10 if the dataset does not say."""
        return self.dataset.fps or 10.0

    def times_s(self, episode: DatasetEpisode) -> npt.NDArray[np.float64]:
        """Return float64 [T], each frame's time; evenly spaced in a dataset without times."""
        times_s = self.dataset.times_s(episode)
        return np.arange(episode.num_frames) / self.fps if times_s is None else times_s

    def rate(self, episode: DatasetEpisode) -> float:
        """Return an episode's frames per second, on average."""
        times_s = self.times_s(episode)
        is_known = self.dataset.fps is not None or len(times_s) < 2
        return self.fps if is_known else round(float((len(times_s) - 1) / times_s[-1]), 3)

    def read(self, reading: Callable[[ShownDataset], Read]) -> Read:
        """Check the dataset, then read from it as it is now. Raises HTTPException 500 with a broken dataset's fault."""
        try:
            self.check()
            return reading(replace(self, dataset=self.dataset.as_now()))
        except DatasetError as error:
            raise HTTPException(500, self._without_folder(str(error))) from None

    @property
    def about(self) -> dict[str, Any]:
        """The dataset's name and kind, and its label files' names."""
        names = [self._name_of(file) for file in find_label_files(self.path)]
        return {"name": self.dataset.source, "kind": self.dataset.kind, "labels": names}

    def table(self, labels: str | None) -> dict[str, Any]:
        """Return a row for each episode, with a summary of its labels.

        ``unused`` has what each camera shows instead of colours (``Dataset.unused_cameras``); null: colours.
        ``left_out`` has the reason for each further camera.
        """
        file = self._labels(labels)
        status = None if file is None else file.stat()
        summary = None if file is None else _summary(file, file.stat().st_mtime_ns)[0]
        unused = self.dataset.unused_cameras(self.dataset.cameras)
        rows = {} if summary is None else dict(zip(summary.episodes.tolist(), _rows(summary), strict=True))
        provenance = None if file is None else read_provenance(file)
        given = {"text": "", "overrides": False} | _part(_part(provenance, "dataset"), "task")
        digest = _part(provenance, "checkpoint").get("weights_digest")
        return {
            "labels": None if file is None else self._name_of(file),
            "cameras": list(self.cameras),
            "is_on_hub": self.dataset.revision is not None,
            "unused": [unused.get(camera) for camera in self.cameras],
            "left_out": dict(self.dataset.left_out),
            "corrections": [asdict(self._correction(file, camera)) for camera in self.cameras],
            "threshold": SuccessRule.threshold,
            "provenance": provenance,
            "warning": ModelInfo.warning_of(digest),
            "written_s": None if status is None else status.st_mtime,
            "episodes": [
                {
                    "episode": episode.index,
                    "name": episode.own_name,
                    "task": given["text"] if given["overrides"] or not episode.task else episode.task,
                    "num_frames": episode.num_frames,
                    **({} if file is None else rows.get(self._number_in(file, episode.index), {})),
                }
                for episode in self.dataset.listing
            ],
        }

    def missing(self, number: int) -> dict[str, Any]:
        """Return the size of what an episode needs from the Hub, null: all is here, and whether to ask before."""
        size = self.dataset.missing([self._numbered(number)], self.cameras)
        return {"size": str(size) if size else None, "asks": size is not None and size.is_large}

    def download(self, number: int) -> dict[str, Any]:
        """Download what an episode needs from the Hub, and return what is missing then."""
        self.dataset.download([self._numbered(number)], self.cameras)
        return self.missing(number)

    def faults(self) -> dict[str, str]:
        """Return why episodes cannot be labelled now, by episode number, as ``rfm-client label`` reports it.

        An episode that must be downloaded first is not checked.
        """
        found = {}
        unused = self.dataset.unused_cameras(self.cameras)
        cameras = [camera for camera in self.cameras if camera not in unused]
        for number in filter(self.dataset.is_here, self.dataset.numbers):
            try:
                for camera in cameras:
                    self.dataset.check(self.dataset.episode(number), camera)
            except DatasetError as error:
                found[str(number)] = self._without_folder(str(error))
        return found

    def curves(self, number: int, labels: str | None) -> dict[str, Any]:
        """Return an episode's curves over time, and its action and state as [D][T]."""
        episode, file = self._episode(number), self._labels(labels)
        times_s = self.times_s(episode)
        times_s = times_s - times_s[0]
        found = None if file is None else read_episode_labels(file, self._number_in(file, number))
        if found is not None and (found.frames.min() < 0 or found.frames.max() >= len(times_s)):
            raise DatasetError.at(f"episode {number}: {file}", f"frames from 0 to {len(times_s) - 1}", "others")
        return {
            "episode": number,
            "name": episode.own_name,
            "fps": self.rate(episode),
            "times_s": times_s.tolist(),
            "curves": [] if found is None else _curves(found, len(times_s)),
            "motion": {
                name: {"names": motion.names, "values": motion.values.T.tolist()}
                for name, motion in self.dataset.motion(episode).items()
            },
        }

    def video(self, number: int, camera: int, take: Callable[[int], object]) -> tuple[bytes, bool]:
        """Return an episode's video as an MP4 file, and True if it has every pixel as stored; False: it was encoded.

        take: called with a byte count before the bytes are allocated
        """
        if not 0 <= camera < len(self.cameras):
            raise HTTPException(404, f"camera: expected one of {len(self.cameras)} with videos, got {camera}")
        episode, name = self._episode(number), self.cameras[camera]
        span = self.dataset.span(episode, name)
        if span is not None:
            off_s = span.times_s - self.times_s(episode)
            if np.ptp(off_s) <= 2 * span.tolerance_s and is_playable(span):  # else a reader knows another rate
                return cut(span, take), True
        return encoded(self.dataset.whole_frames(episode, name), self.rate(episode), take), False

    def preview(self, number: int, labels: str | None, take: Callable[[int], object]) -> dict[str, Any]:
        """Return an episode's progress at a few points, and its ``ends`` as JPEG in base64; none: they cannot be read.

        name, num_frames: the episode's, to tell it from one that had this number before

        take: see ``video``
        """
        file = self._labels(labels)
        found = None if file is None else read_episode_labels(file, self._number_in(file, self._numbered(number)))
        progress = None if found is None else found.fused.progress
        if progress is not None:
            places = np.linspace(0, len(progress) - 1, min(_POINTS, len(progress))).round().astype(int)
            progress = progress[places]
        unused = self.dataset.unused_cameras(self.cameras)
        camera = next((each for each in self.cameras if each not in unused), None)
        if not self.dataset.is_here(number):
            camera = None
        pictures: list[str] = []
        if camera is not None:
            with suppress(DatasetError):  # the list of faults reports it
                correction = self._correction(file, camera)
                ends = self.ends(self._episode(number), camera)
                pictures = [_jpeg(correction.applied(frame), take) for frame in ends]
        listed = self.dataset.listed(number)
        about = {"name": listed.own_name, "num_frames": listed.num_frames, "pictures": pictures}
        return {**about, "progress": [] if progress is None else progress.tolist()}

    def ends(self, episode: DatasetEpisode, camera: str) -> list[UInt8Array]:
        """Return the first stored frame, and of a video the last. Raises DatasetError."""
        span = self.dataset.span(episode, camera)
        if span is None:
            return list(itertools.islice(self.dataset.stored_frames(episode, camera), 1))
        return [frame for t in (0, -1) for frame in replace(span, times_s=span.times_s[[t]]).frames()]

    def _without_folder(self, message: str) -> str:
        """Return a message without the folder's path, for users on other machines."""
        return message.replace(str(self.root), self.dataset.source)

    def _episode(self, number: int) -> DatasetEpisode:
        self._numbered(number)
        if not self.dataset.is_here(number) and (size := self.dataset.missing([number], self.cameras)):
            raise HTTPException(409, f"episode {number}: expected it here, got {size} on the Hub: download it first")
        return self.dataset.episode(number)

    def _numbered(self, number: int) -> int:
        known = self.dataset.numbers
        if number not in known:
            expected = f"one from {known[0]} to {known[-1]}" if known else "none, since the dataset is empty"
            gaps = ", with gaps" if known and known[-1] - known[0] >= len(known) else ""
            raise HTTPException(404, f"episode: expected {expected}{gaps}, got {number}")
        return number

    def _labels(self, name: str | None) -> Path | None:
        """Return the label file with this name, by default the first; None: no labels."""
        files = {self._name_of(file): file for file in find_label_files(self.path)}
        if name is None:
            name = next(iter(files), None)
        if name is not None and name not in files:
            raise HTTPException(404, f"labels: expected one of {', '.join(files) or 'none'}, got another")
        return None if name is None else files[name]

    def _number_in(self, file: Path, number: int) -> int:
        """Return an episode's number in a label file; by name, since a folder's numbers change. -1: none."""
        _, numbers = _summary(file, file.stat().st_mtime_ns)
        name = self.dataset.episode(number).own_name if numbers else None
        return number if name is None else numbers.get(name, -1)

    def _correction(self, file: Path | None, camera: str) -> Correction:
        """Return how these labels made the camera's frames upright RGB; without labels, how the dataset does now."""
        if file is None:
            return self.dataset.corrections.get(camera, Correction())
        provenance = read_provenance(file)
        orient = _part(provenance, "orientations").get(camera)  # labels from version 0.1.0 have none
        order = _part(provenance, "channels").get(camera)
        is_known = orient in get_args(Orientation), order in get_args(ChannelOrder)
        return Correction(orient if is_known[0] else "none", order if is_known[1] else "rgb")

    def _name_of(self, file: Path) -> str:
        return file.relative_to(self.root).as_posix()


@lru_cache(_SUMMARIES_AT_A_TIME)
def _summary(file: Path, _changed_ns: int) -> tuple[Summary, Mapping[str, int]]:
    """Return a label file's summary, and the numbers of its episodes with names by name."""
    summary = summarise(file)
    return summary, {name: number for number, name in summary.names.items()}


def _part(document: Mapping[str, Any] | None, name: str) -> Any:
    """Return a dict in the provenance; empty if there is none, or another writer's text."""
    part = (document or {}).get(name)
    return part if isinstance(part, dict) else {}


def _rows(summary: Summary) -> list[dict[str, Any]]:
    """Return the summary's rows, one per episode."""
    columns: dict[str, Sequence[Any]] = {
        "final_progress": summary.final_progress.tolist(),
        "backwards": summary.backwards.tolist(),
    }
    for name in ("best_success", "last_success", "voted_success", "disagreement"):
        if (values := getattr(summary, name)) is not None:
            columns[name] = values.tolist()
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _curves(labels: EpisodeLabels, num_frames: int) -> list[dict[str, Any]]:
    """Return the fused curve, which training reads, then the curve of each camera."""
    curves = [(None, labels.fused), *labels.cameras.items()]
    answered = np.ones(num_frames, bool)
    answered[labels.frames] = labels.is_answered
    marks = {"answered": answered.tolist()}  # False: the model skipped the frame; also True for a frame without labels
    return [{"camera": camera, **_scores(curve, labels.frames, num_frames), **marks} for camera, curve in curves]


def _scores(curve: Curve, frames: npt.NDArray[np.int64], num_frames: int) -> dict[str, Any]:
    """Return scores for all frames, null for frames without a label. frames: numbers of the labelled frames"""
    scores: dict[str, Any] = {"progress": None, "success": None}
    for name in scores:
        labelled = getattr(curve, name)
        if labelled is not None:
            of_all = np.full(num_frames, np.nan)
            of_all[frames] = labelled
            scores[name] = of_all.tolist()
    return scores


def _jpeg(frame: UInt8Array, take: Callable[[int], object]) -> str:
    """Return a frame as a small JPEG in base64. take: see ``encoded``"""
    take(frame.nbytes)
    image = Image.fromarray(frame)
    image.thumbnail(_PREVIEW_PX)
    jpeg = io.BytesIO()
    image.save(jpeg, "JPEG")
    return base64.b64encode(jpeg.getvalue()).decode()


def links_in(folder: Path) -> Iterator[Path]:
    """Yield all links below a folder; 100,000 files take 0.1 s.

    Raises DatasetError for a folder that hides them, and for pipes, sockets and devices, on which reading would block.
    """
    if not os.access(folder, os.X_OK):  # nothing in it can be opened
        return
    try:
        with os.scandir(folder) as entries:
            others = [entry for entry in entries if entry.is_symlink() or not entry.is_file()]
    except OSError as error:
        raise DatasetError.at(folder, "a folder whose files can be listed", error.strerror) from error
    for entry in others:
        if entry.is_symlink():
            yield Path(entry.path)
        elif entry.is_dir():
            yield from links_in(Path(entry.path))
        else:
            raise DatasetError.at(Path(entry.path), "a file or a folder", "a pipe, a socket or a device")


def check_links(root: Path, paths: Iterable[Path]) -> None:
    """Raise DatasetError for a path whose file is not in ``root``, a folder with links resolved.

    Otherwise the dataset's author could show other files from this machine.
    """
    for path in paths:
        try:
            is_inside = path.resolve().is_relative_to(root)
        except (OSError, RuntimeError):  # links in a circle
            is_inside = False
        if not is_inside:
            raise DatasetError.at(path, "a file in the dataset's folder", "a link that leaves it: copy the file there")
