# SPDX-License-Identifier: MIT
"""Files of labels read back: what their columns are, and the curves of one episode. Needs pyarrow. T frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client.contract.samples import Float32Array
from rfm_client.data.datasets.protocol import DatasetError
from rfm_client.labelling.episode_scores import PROGRESS, SUCCESS

PROGRESS_ENDING = "_progress.parquet"
SIGNALS_FOLDER = "reward_signals"

_PROGRESS_NAMES = ("progress_sparse", "progress_dense", "progress")
_OWN_NAME = "rfm"  # of labels whose name nobody chose


@dataclass(frozen=True)
class LabelColumns:
    """Names of the columns of scores in a file of labels.

    success: None: the checkpoint does not predict it
    progress_of, success_of: each camera's, where there are several
    """

    progress: str
    success: str | None
    progress_of: Mapping[str, str]
    success_of: Mapping[str, str]

    @classmethod
    def among(cls, file: object, names: Sequence[str]) -> LabelColumns:
        """Those of either form of file. Raises DatasetError if there is no progress, or no episode."""
        if "episode_index" not in names:
            raise DatasetError.at(file, "the column episode_index", ", ".join(names))
        for name in _PROGRESS_NAMES:
            if name in names:
                return cls._named(names, name, PROGRESS, SUCCESS)
        for name in names:
            if name.startswith("reward.") and name.endswith(".progress"):
                return cls._named(names, name, name, name.removesuffix("progress") + "success_probability")
        raise DatasetError.at(file, "a column of progress", ", ".join(names))

    @classmethod
    def _named(cls, names: Sequence[str], fused: str, progress: str, success: str) -> LabelColumns:
        """progress, success: how the names of each camera's columns begin"""
        has_success = success in names
        success_of = _by_camera(names, success) if has_success else {}
        return cls(fused, success if has_success else None, _by_camera(names, progress), success_of)

    @property
    def all(self) -> list[str]:
        """Every column of scores."""
        return [
            self.progress,
            *([self.success] if self.success else []),
            *self.progress_of.values(),
            *self.success_of.values(),
        ]


@dataclass(frozen=True, eq=False)
class Curve:
    """float32 [T] each, NaN where there is no label. success: None: the checkpoint does not predict it"""

    progress: Float32Array
    success: Float32Array | None


@dataclass(frozen=True, eq=False)
class EpisodeLabels:
    """The labels of one episode.

    frames: int64 [T], the numbers of its frames that are labelled
    cameras: each camera's curve, where there are several; ``fused`` is what became of them
    """

    frames: npt.NDArray[np.int64]
    fused: Curve
    cameras: Mapping[str, Curve]


def find_label_files(root: Path) -> list[Path]:
    """The files of labels in a dataset's folder. Those under the default name come first.

    Of labels that are there in both forms, only the progress file is named.
    """
    progress = sorted(root.glob(f"*{PROGRESS_ENDING}"))
    named = {file.name.removesuffix(PROGRESS_ENDING) for file in progress}
    signals = [file for file in sorted((root / SIGNALS_FOLDER).glob("*.parquet")) if file.stem not in named]
    files = [file for file in (*progress, *signals) if not file.name.startswith(".")]
    return sorted(files, key=lambda file: file.name.removesuffix(PROGRESS_ENDING) != _OWN_NAME)


def read_label_table(file: Path, *, episode: int | None = None, more: Sequence[str] = ()) -> tuple[Any, LabelColumns]:
    """The table of a file of labels: ``episode_index``, all scores, and ``more`` columns. Raises DatasetError.

    episode: the rows of this one alone
    """
    from pyarrow import ArrowException, parquet

    try:
        columns = LabelColumns.among(file, parquet.read_schema(file).names)
        filters = None if episode is None else [("episode_index", "=", episode)]
        names = ["episode_index", *more, *columns.all]
        table = parquet.read_table(file, columns=names, filters=filters, partitioning=None)
    except (OSError, ArrowException) as error:
        raise DatasetError.at(file, "a file of labels", str(error)) from error
    missing = [name for name in names if name not in table.column_names]
    if missing:
        raise DatasetError.at(file, f"the column {missing[0]}", ", ".join(table.column_names))
    return table, columns


def read_episode_labels(file: Path, episode: int) -> EpisodeLabels | None:
    """The labels of an episode; None: the file has none of it. Raises DatasetError."""
    table, columns = read_label_table(file, episode=episode, more=("frame_index",))
    if not len(table):
        return None

    def curve(progress: str, success: str | None) -> Curve:
        return Curve(table[progress].to_numpy(), None if success is None else table[success].to_numpy())

    return EpisodeLabels(
        frames=table["frame_index"].to_numpy(),
        fused=curve(columns.progress, columns.success),
        cameras={
            camera: curve(progress, columns.success_of.get(camera)) for camera, progress in columns.progress_of.items()
        },
    )


def _by_camera(names: Sequence[str], begin: str) -> dict[str, str]:
    return {name.removeprefix(f"{begin}."): name for name in names if name.startswith(f"{begin}.")}
