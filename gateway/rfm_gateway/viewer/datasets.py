# SPDX-License-Identifier: MIT
"""The datasets that the page shows: LeRobot's, in folders that the operator names, with labels or without.

Their files are read where they are. A link that leaves a dataset's folder is followed nowhere: whoever made the dataset
might have named files of this machine. Needs pyarrow. T frames of an episode.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client.contract.results import SUCCESS_THRESHOLD
from rfm_client.contract.settings import ConfigError
from rfm_client.data.datasets.films import Span
from rfm_client.data.datasets.lerobot import LeRobotDataset
from rfm_client.data.datasets.lerobot_rows import INFO_FILE
from rfm_client.data.datasets.protocol import DatasetEpisode, DatasetError
from rfm_client.data.orientation import ORIENTATIONS
from rfm_client.labelling.label_files import (
    PROVENANCE_KEY,
    SIGNALS_PROVENANCE_KEY,
    Curve,
    EpisodeLabels,
    find_label_files,
    read_episode_labels,
)
from rfm_client.labelling.summary import Summary, summarise

NUM_BINS = 20  # of the final progress, from 0 to 1
_SUMMARIES_AT_A_TIME = 8  # that are kept in memory


class UnknownError(LookupError):
    """Something that the datasets do not have, reported as ``where: expected X, got Y``."""


@dataclass(frozen=True)
class ShownDataset:
    """A dataset that the page shows. root: its folder, without links on the way to it"""

    root: Path
    dataset: LeRobotDataset

    @classmethod
    def open(cls, folder: str) -> ShownDataset:
        """The dataset in a folder. Raises ConfigError for another folder, a broken dataset, or links that leave it."""
        try:
            import pyarrow  # noqa: F401
        except ImportError:
            expected = 'expected pyarrow, which reads datasets, got none: pip install "./client[label]"'
            raise ConfigError("dataset", expected) from None
        if not (Path(folder) / INFO_FILE).is_file():
            expected = f"expected the folder of a LeRobot dataset, which holds {INFO_FILE}, got {folder}"
            raise ConfigError("dataset", expected)
        root = Path(folder).resolve()
        try:
            _check_links(root)
            return cls(root, LeRobotDataset(root))
        except DatasetError as error:
            raise ConfigError("dataset", str(error)) from None

    @property
    def about(self) -> dict[str, Any]:
        """What it is, and which labels are there now."""
        names = [self._name_of(file) for file in find_label_files(self.root)]
        return {"name": self.dataset.source, "kind": self.dataset.kind, "labels": names}

    def table(self, labels: str | None) -> dict[str, Any]:
        """Every episode, with what these labels say of it at a glance. Raises DatasetError, UnknownError."""
        file = self._labels(labels)
        summary = None if file is None else _summary(file, file.stat().st_mtime_ns)
        rows = {} if summary is None else dict(zip(summary.episodes.tolist(), _rows(summary), strict=True))
        return {
            "labels": None if file is None else self._name_of(file),
            "cameras": list(self.dataset.info.films),
            "orientations": [_orientations(file).get(camera, "none") for camera in self.dataset.info.films],
            "fps": self.dataset.info.fps,
            "threshold": SUCCESS_THRESHOLD,
            "bins": None if summary is None else _bins(summary),
            "episodes": [
                {
                    "episode": episode.index,
                    "task": episode.task,
                    "num_frames": episode.num_frames,
                    **rows.get(episode.index, {}),
                }
                for episode in self._episodes
            ],
        }

    def curves(self, number: int, labels: str | None) -> dict[str, Any]:
        """An episode's curves over the time in it. Raises DatasetError, UnknownError."""
        episode, file = self._episode(number), self._labels(labels)
        times_s = self.dataset.times_s(episode)
        times_s = times_s - times_s[0]
        found = None if file is None else read_episode_labels(file, number)
        if found is not None and (found.frames.min() < 0 or found.frames.max() >= len(times_s)):
            raise DatasetError.at(f"episode {number}: {file}", f"frames from 0 to {len(times_s) - 1}", "others")
        return {
            "episode": number,
            "task": episode.task,
            "times_s": times_s.tolist(),
            "curves": [] if found is None else _curves(found, len(times_s)),
        }

    def span(self, number: int, camera: int) -> Span:
        """Where an episode is in the film of a camera. Raises DatasetError, UnknownError."""
        cameras = self.dataset.info.films
        if not 0 <= camera < len(cameras):
            raise UnknownError(f"camera: expected one of {len(cameras)} with films, got {camera}")
        episode = self._episode(number)
        _check_inside(self.root, self.dataset.film(episode, cameras[camera]))
        return self.dataset.span(episode, cameras[camera])

    def without_folder(self, message: str) -> str:
        """A message for people elsewhere, whom the place of the dataset on this machine does not concern."""
        return message.replace(str(self.root), self.dataset.source)

    @cached_property
    def _episodes(self) -> Sequence[DatasetEpisode]:
        for file in self.dataset.files():
            if file.suffix == ".parquet":
                _check_inside(self.root, file)
        return self.dataset.episodes

    def _episode(self, number: int) -> DatasetEpisode:
        if not 0 <= number < len(self._episodes):
            raise UnknownError(f"episode: expected one from 0 to {len(self._episodes) - 1}, got {number}")
        return self._episodes[number]

    def _labels(self, name: str | None) -> Path | None:
        """The file of labels of this name, by default the first; None: there are no labels."""
        files = {self._name_of(file): file for file in find_label_files(self.root)}
        if name is None:
            name = next(iter(files), None)
        if name is not None and name not in files:
            raise UnknownError(f"labels: expected one of {', '.join(files) or 'none'}, got another")
        file = None if name is None else files[name]
        if file is not None:
            _check_inside(self.root, file)
        return file

    def _name_of(self, file: Path) -> str:
        return file.relative_to(self.root).as_posix()


def _numbers(values: Iterable[float]) -> list[float | None]:
    """Scores as JSON has them: null for one that is not there."""
    return [None if math.isnan(value) else value for value in values]


def _orientations(file: Path | None) -> Mapping[str, str]:
    """How the pictures of each camera that was turned were turned for these labels."""
    from pyarrow import parquet

    metadata = {} if file is None else parquet.read_schema(file).metadata or {}
    provenance = json.loads(metadata.get(PROVENANCE_KEY, metadata.get(SIGNALS_PROVENANCE_KEY, b"{}")))
    found = provenance.get("orientations", {})  # labels of version 0.1.0 have none
    return {camera: orientation for camera, orientation in found.items() if orientation in ORIENTATIONS}


@lru_cache(_SUMMARIES_AT_A_TIME)
def _summary(file: Path, _changed_ns: int) -> Summary:
    return summarise(file)


def _rows(summary: Summary) -> list[dict[str, Any]]:
    """What a summary says of each episode."""
    columns: dict[str, Sequence[Any]] = {
        "final_progress": _numbers(summary.final_progress.tolist()),
        "backwards": _numbers(summary.backwards.tolist()),
    }
    never = summary.never_succeed
    if summary.best_success is not None and never is not None:
        columns["best_success"] = _numbers(summary.best_success.tolist())
        columns["never_succeeds"] = np.isin(summary.episodes, never).tolist()
    if summary.disagreement is not None:
        columns["disagreement"] = _numbers(summary.disagreement.tolist())
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _bins(summary: Summary) -> dict[str, list[float]]:
    """How many episodes end with which progress."""
    final = summary.final_progress[np.isfinite(summary.final_progress)]
    counts, edges = np.histogram(np.clip(final, 0, 1), NUM_BINS, (0, 1))
    return {"edges": edges.tolist(), "counts": counts.tolist()}


def _curves(labels: EpisodeLabels, num_frames: int) -> list[dict[str, Any]]:
    """The curve that training reads, which is no camera's, and then each camera's."""
    curves = [(None, labels.fused), *labels.cameras.items()]
    return [{"camera": camera, **_scores(curve, labels.frames, num_frames)} for camera, curve in curves]


def _scores(curve: Curve, frames: npt.NDArray[np.int64], num_frames: int) -> dict[str, Any]:
    """A score of every frame, where some may have no label. frames: the numbers of those that have"""
    scores: dict[str, Any] = {"progress": None, "success": None}
    for name in scores:
        labelled = getattr(curve, name)
        if labelled is not None:
            of_all = np.full(num_frames, np.nan)
            of_all[frames] = labelled
            scores[name] = _numbers(of_all.tolist())
    return scores


def _check_links(root: Path) -> None:
    """Raises DatasetError for a link in a folder that leads out of it."""
    for folder, folders, files in os.walk(root):
        for name in (*folders, *files):
            path = Path(folder, name)
            if path.is_symlink():
                _check_inside(root, path)


def _check_inside(root: Path, file: Path) -> None:
    """Raises DatasetError for a file that lies elsewhere once its links are followed."""
    try:
        is_inside = file.resolve().is_relative_to(root)
    except (OSError, RuntimeError):  # links in a circle
        is_inside = False
    if not is_inside:
        raise DatasetError.at(file, "a file in the dataset's folder", "a link that leaves it: copy the file there")
