# SPDX-License-Identifier: MIT
"""Read label files of all formats: whole tables, single episodes, and how they were made. Needs pyarrow."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from rfm_client import Float32Array
from rfm_labels.datasets.dataset import SIGNALS_FOLDER, Dataset
from rfm_labels.datasets.faults import DatasetError, listed, require
from rfm_labels.datasets.hdf5 import label_prefix
from rfm_labels.datasets.lerobot_meta import INFO_FILE
from rfm_labels.metadata import (
    PROGRESS,
    SUCCESS,
    BlankCameras,
    Columns,
    Cost,
    blank_from_metadata,
    parsed_object,
    skipping_in,
)
from rfm_labels.plan import Item, Plan, make_plan
from rfm_labels.writing import (
    COST_KEY,
    EPISODES_KEY,
    IDENTITY,
    PROGRESS_ENDING,
    PROVENANCE_KEY,
    SIGNAL_NAMES,
    SIGNALS_PROVENANCE_KEY,
)

Reader: TypeAlias = Callable[[Sequence[Item]], Iterator[tuple[Item, Columns]]]

_OWN_NAME = "rfm"  # default of ``LabelOptions.name``
_PROGRESS_NAMES = ("progress", "progress_sparse", "progress_dense")
_OTHERS = "those of others, or of videos that have changed or were copied (--verify knows copies by their content)"


def parquet_labels(path: Path, option: str = "--name") -> LabelFile:
    """Return the labels in a file. ``option``: the command-line option that chooses another path."""
    from pyarrow import ArrowException, parquet

    try:
        metadata = parquet.read_schema(path).metadata or {}
    except (OSError, ArrowException):
        metadata = {}
    provenance = metadata.get(PROVENANCE_KEY, metadata.get(SIGNALS_PROVENANCE_KEY))
    cost = Cost.parse(metadata.get(COST_KEY))
    blank = blank_from_metadata(metadata)
    digests = metadata.get(EPISODES_KEY)
    return LabelFile.of(path, provenance, digests, lambda items: _read(path, items), option, cost, blank)


def _read(path: Path, items: Sequence[Item]) -> Iterator[tuple[Item, Columns]]:
    table = read_label_table(path)
    episodes = table["episode_index"].to_numpy()
    names = [name for name in table.column_names if name not in IDENTITY]
    for item in items:
        start, end = np.searchsorted(episodes, [item.episode.index, item.episode.index + 1]).tolist()
        rows = table.slice(start, end - start)
        yield item, {name: rows[name].to_numpy() for name in names}


@dataclass(frozen=True, eq=False)
class Curve:
    """Scores of T frames, float32 [T] each, NaN for a frame without a label. success: None: not predicted"""

    progress: Float32Array
    success: Float32Array | None


@dataclass(frozen=True, eq=False)
class EpisodeLabels:
    """The labels of one episode, with T labelled frames.

    frames: int64 [T], numbers of the labelled frames in the episode
    fused: scores fused over all cameras
    cameras: each camera's scores; empty for a single camera
    is_answered: bool [T], False at the frames that the model skipped
    """

    frames: npt.NDArray[np.int64]
    fused: Curve
    cameras: Mapping[str, Curve]
    is_answered: npt.NDArray[np.bool_]


def find_label_files(root: Path) -> list[Path]:
    """Return the label files of a dataset, those with the default name first.

    root: the dataset's folder, or HDF5 file

    For labels in both formats, return only the progress file. Raises DatasetError for a folder with labels of several
    HDF5 files.
    """
    folder = root.parent if root.is_file() else root
    progress = sorted(folder.glob(f"[!.]*{PROGRESS_ENDING}"))
    named = {reward_name(file) for file in progress}
    signals = [file for file in sorted((folder / SIGNALS_FOLDER).glob("[!.]*.parquet")) if file.stem not in named]
    files = sorted((*progress, *signals), key=lambda file: reward_name(file).rpartition(".")[2] != _OWN_NAME)
    if root.is_file():
        return [file for file in files if _prefix(file) == label_prefix(root)]
    prefixes = sorted({_prefix(file) for file in files})
    is_one = len(prefixes) < 2 or (root / INFO_FILE).is_file()
    got = f"{', '.join(prefix.rstrip('.') or 'others' for prefix in prefixes)}: name one of the HDF5 files"
    require(folder, is_one, "labels of one dataset", got)
    return files


def reward_name(file: Path) -> str:
    """Return the name of the reward in a label file, after the dataset's ``label_prefix``."""
    return file.name.removesuffix(PROGRESS_ENDING).removesuffix(".parquet")


def _prefix(file: Path) -> str:
    before, dot, _ = reward_name(file).rpartition(".")
    return before + dot


def read_label_table(file: Path, *, episode: int | None = None) -> Any:
    """Return a label file of any format as a pyarrow Table, with the parts' column names. Raises DatasetError.

    Score columns: those of ``SCORES``, as far as the file has them.

    episode: only this episode's rows; None: all
    """
    from pyarrow import ArrowException, parquet

    try:
        names = parquet.read_schema(file).names
        columns = {**{name: name for name in IDENTITY if name in names}, **_score_columns(file, names)}
        filters = None if episode is None else [("episode_index", "=", episode)]
        table = parquet.read_table(file, columns=list(columns.values()), filters=filters, partitioning=None)
    except (OSError, ArrowException) as error:
        raise _no_labels(file, error) from error
    return table.select(list(columns.values())).rename_columns(list(columns))


def read_cost(file: Path) -> Cost | None:
    """Return the cost of a file's labels; None: the file does not say. Raises DatasetError."""
    return Cost.parse(_metadata(file).get(COST_KEY))


def read_blank(file: Path) -> BlankCameras:
    """Return the cameras that show nothing, as the metadata of a file's labels tell them. Raises DatasetError."""
    return blank_from_metadata(_metadata(file))


def read_provenance(file: Path) -> dict[str, Any]:
    """Return writer, dataset and recipe of a label file, as far as it tells them. Raises DatasetError."""
    metadata = _metadata(file)
    return parsed_object(metadata.get(PROVENANCE_KEY, metadata.get(SIGNALS_PROVENANCE_KEY)))


def _metadata(file: Path) -> Mapping[bytes, bytes]:
    from pyarrow import ArrowException, parquet

    try:
        return parquet.read_schema(file).metadata or {}
    except (OSError, ArrowException) as error:
        raise _no_labels(file, error) from error


def _no_labels(file: Path, error: Exception) -> DatasetError:
    is_missing = isinstance(error, FileNotFoundError)
    got = "none: label the dataset first, or name another file" if is_missing else error
    return DatasetError.at(file, "a file of labels", got)


def read_episode_labels(file: Path, episode: int) -> EpisodeLabels | None:
    """Return the labels of an episode; None: the file does not have the episode. Raises DatasetError."""
    table = read_label_table(file, episode=episode)
    require(file, "frame_index" in table.column_names, "the column frame_index", ", ".join(table.column_names))
    if not len(table):
        return None

    def curve(dot_camera: str = "") -> Curve:
        success = f"{SUCCESS}{dot_camera}"
        has_success = success in table.column_names
        return Curve(table[f"{PROGRESS}{dot_camera}"].to_numpy(), table[success].to_numpy() if has_success else None)

    cameras = [name.partition(".")[2] for name in table.column_names if name.startswith(f"{PROGRESS}.")]
    skipping = skipping_in(table.column_names)
    is_answered = np.ones(len(table), bool) if skipping is None else np.isfinite(table[skipping].to_numpy())
    curves = {camera: curve(f".{camera}") for camera in cameras}
    return EpisodeLabels(table["frame_index"].to_numpy(), curve(), curves, is_answered)


def _score_columns(file: Path, names: Sequence[str]) -> dict[str, str]:
    """Score columns by their names in the parts. Raises DatasetError without progress or ``episode_index``."""
    require(file, "episode_index" in names, "the column episode_index", ", ".join(names))
    own = next((name for name in _PROGRESS_NAMES if name in names), None)
    signal = next((name for name in names if name.startswith("reward.") and name.endswith(".progress")), None)
    progress = own or signal
    if progress is None:
        raise DatasetError.at(file, "a column of progress", ", ".join(names))
    before = progress.removesuffix("progress")
    begins = {score: score if own is not None else before + signal for score, signal in SIGNAL_NAMES.items()}
    columns = {}  # in the order of ``SCORES``
    for score, begin in begins.items():
        if (fused := progress if score == PROGRESS else begin) in names:
            columns[score] = fused
            columns |= {score + name.removeprefix(begin): name for name in names if name.startswith(f"{begin}.")}
    return columns


@dataclass(frozen=True)
class LabelFile:
    """An existing label file.

    flaw: why no run can keep its labels; None: its metadata tells how they were made
    digests: digest of each labelled item, by episode number
    read: yields the scores of items, as far as the file has them
    option: command-line option that chooses another name
    cost: of the last run that scored; None: unknown
    blank: cameras that show nothing
    """

    path: Path
    flaw: str | None
    provenance: Mapping[str, Any]
    digests: Mapping[int, str]
    read: Reader
    option: str
    cost: Cost | None = None
    blank: BlankCameras = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        path: Path,
        provenance: Any,
        digests: Any,
        read: Reader,
        option: str = "--name",
        cost: Cost | None = None,
        blank: BlankCameras | None = None,
    ) -> LabelFile:
        """Return the label file. provenance, digests: JSON texts of its metadata, None if absent"""
        told, by_episode = parsed_object(provenance), parsed_object(digests)
        if not str(told.get("writer")).startswith("rfm-client") or not isinstance(told.get("dataset"), dict):
            return cls(path, "labels of another program", {}, {}, read, option)
        known = {int(index): str(digest) for index, digest in by_episode.items() if index.isdecimal()}
        flaw = None if known else "no digests of its episodes"
        return cls(path, flaw, told, known, read, option, cost, blank or {})

    def check(self, plan: Plan, dataset: Dataset, known: Mapping[int, Item]) -> Mapping[int, Item]:
        """Return the file's items by episode number. Raises DatasetError if labels would be lost, or do not fit.

        known: items of the plan, and of label files checked before
        """
        there, now = _settings(_recipe(self.provenance)), _settings(_recipe(plan.provenance()))
        names = [name for name in dict.fromkeys([*now, *there]) if there.get(name) != now.get(name)]
        differ = "; ".join(f"{name}: {there.get(name, 'none')} there, {now.get(name, 'none')} now" for name in names)
        got = (self.provenance and differ) or self.flaw or ""
        require(self.path, self.flaw is None and not differ, "no labels, or those of the same recipe", got)

        lost = set(self.digests) - set(dataset.numbers)
        expected = f"labels of the dataset's {len(dataset.numbers)} episodes"
        require(self.path, not lost, expected, f"some of episode {min(lost, default=None)}")
        others = [dataset.episode(index) for index in sorted(self.digests) if index not in known]
        items = {item.episode.index: item for item in make_plan(dataset, plan.recipe, others).items}
        found = {index: {**known, **items}[index] for index in self.digests}
        changed = [index for index, digest in self.digests.items() if found[index].digest != digest]
        require(self.path, len(changed) < len(self.digests), "labels of this dataset's episodes", _OTHERS)
        chosen = {item.episode.index for item in plan.items}
        left = sorted(set(changed) - chosen)
        episodes = ", ".join(found[index].episode.name for index in left)
        expected = f"no change since the labels in {self.path}, or --episodes with {listed(left)}"
        require(episodes, not left, expected, "other frames or rows")
        return found


def _recipe(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """The provenance without the dataset's source: the episodes' digests identify the dataset."""
    dataset = provenance.get("dataset", {})
    return {**provenance, "writer": None, "dataset": {"kind": dataset.get("kind")}}


def _settings(document: Mapping[str, Any]) -> dict[str, str]:
    """Settings by their paths in messages, for example ``sampling.frames``."""
    settings: dict[str, str] = {}
    for name, value in document.items():
        if isinstance(value, Mapping):
            settings |= {f"{name}.{inner}": text for inner, text in _settings(value).items()}
        elif value is not None:
            settings[name] = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return settings
