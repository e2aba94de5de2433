# SPDX-License-Identifier: MIT
"""Read label files: whole tables, single episodes, and how they were made. Needs pyarrow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client import Float32Array, ModelInfo
from rfm_labels.datasets.dataset import SIGNALS_FOLDER
from rfm_labels.datasets.faults import DatasetError, listed, require
from rfm_labels.datasets.hdf5 import label_prefix
from rfm_labels.datasets.lerobot_meta import INFO_FILE
from rfm_labels.datasets.stored_files import digest_of
from rfm_labels.metadata import (
    PROGRESS,
    SUCCESS,
    BlankCameras,
    blank_from_metadata,
    parsed_object,
    skipping_in,
    values_of,
)
from rfm_labels.plan import Plan
from rfm_labels.writing import (
    EPISODES_KEY,
    IDENTITY,
    NAMES_KEY,
    PROGRESS_ENDING,
    PROVENANCE_KEY,
    SIGNAL_NAMES,
    SIGNALS_PROVENANCE_KEY,
)

_OWN_NAME = "rfm"  # default for ``LabelOptions.name``
_PROGRESS_NAMES = ("progress", "progress_sparse", "progress_dense")


@dataclass(frozen=True, eq=False)
class Curve:
    """Scores for T frames, float32 [T] each, NaN at frames without a label. success: None: not predicted."""

    progress: Float32Array
    success: Float32Array | None


@dataclass(frozen=True, eq=False)
class EpisodeLabels:
    """One episode's labels, at T labelled frames.

    frames: int64 [T], frame numbers within the episode
    fused: scores fused over all cameras
    cameras: scores by camera; empty for a single camera
    is_answered: bool [T], False at the frames that the model skipped
    """

    frames: npt.NDArray[np.int64]
    fused: Curve
    cameras: Mapping[str, Curve]
    is_answered: npt.NDArray[np.bool_]


def find_label_files(root: Path, folder: Path | None = None) -> list[Path]:
    """Find a dataset's label files, with the default name first.

    root: the dataset's folder, or HDF5 file
    folder: of the label files; None: beside the dataset

    For labels in both formats, return only the progress file. Raises DatasetError for a folder with labels for several
    HDF5 files.
    """
    folder = folder or (root.parent if root.is_file() else root)
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


def equal_files(files: Sequence[Path]) -> dict[Path, Path]:
    """Return the first file with the same labels for each file, for example the one that an alias copies."""
    first: dict[str, Path] = {}
    found = {}
    for file in files:
        try:
            table = read_label_table(file)
            key = digest_of(name.encode() + values_of(table[name]).tobytes() for name in table.column_names)
        except DatasetError:  # no label file: equals itself
            key = str(file)
        found[file] = first.setdefault(key, file)
    return found


def reward_name(file: Path) -> str:
    """Return the reward's name, including the dataset's ``label_prefix``, from the file name."""
    return file.name.removesuffix(PROGRESS_ENDING).removesuffix(".parquet")


def _prefix(file: Path) -> str:
    before, dot, _ = reward_name(file).rpartition(".")
    return before + dot


def read_label_table(file: Path, *, episode: int | None = None) -> Any:
    """Read a label file in any format as a pyarrow Table, with the parts' column names. Raises DatasetError.

    Rows are sorted by episode and frame. Score columns: those in ``SCORES`` that the file has.

    episode: read only this episode's rows; None: all
    """
    from pyarrow import ArrowException, parquet

    try:
        names = parquet.read_schema(file).names
        columns = {**{name: name for name in IDENTITY if name in names}, **_score_columns(file, names)}
        filters = None if episode is None else [("episode_index", "=", episode)]
        table = parquet.read_table(file, columns=list(columns.values()), filters=filters, partitioning=None)
    except (OSError, ArrowException) as error:
        raise _no_labels(file, error) from error
    table = table.select(list(columns.values())).rename_columns(list(columns))
    order = np.lexsort((values_of(table["frame_index"]), values_of(table["episode_index"])))
    return table if np.array_equal(order, np.arange(len(order))) else table.take(order)


def read_blank(file: Path) -> BlankCameras:
    """Read the blank cameras from a label file's metadata. Raises DatasetError."""
    return blank_from_metadata(_metadata(file))


def read_provenance(file: Path) -> dict[str, Any]:
    """Read a label file's writer, dataset and recipe, as far as recorded. Raises DatasetError."""
    return _provenance(_metadata(file))


def read_names(*files: Path) -> dict[int, str]:
    """Read the names of the label files' episodes by number; empty for LeRobot's.

    Raises DatasetError, also if a number has another name in another file.
    """
    known: dict[int, tuple[str, Path]] = {}
    for file in files:
        for number, name in parsed_object(_metadata(file).get(NAMES_KEY)).items():
            there, first = known.setdefault(int(number), (str(name), file))
            got = f"{name}: label again with the older file's --name, or choose one file with --labels"
            require(f"{file}: episode {number}", str(name) == there, f"{there} as in {first}", got)
    return {number: name for number, (name, _) in known.items()}


def _provenance(metadata: Mapping[bytes, bytes]) -> dict[str, Any]:
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
    """Return an episode's labels; None: the file does not have the episode. Raises DatasetError."""
    table = read_label_table(file, episode=episode)
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
    """Map the parts' score column names to the file's. Raises DatasetError without progress or frame numbers."""
    for name in IDENTITY[1:]:
        require(file, name in names, f"the column {name}", ", ".join(names))
    own = next((name for name in _PROGRESS_NAMES if name in names), None)
    signal = next((name for name in names if name.startswith("reward.") and name.endswith(".progress")), None)
    progress = own or signal
    if progress is None:
        raise DatasetError.at(file, "a column of progress", ", ".join(names))
    before = progress.removesuffix("progress")
    begins = {score: score if own is not None else before + signal for score, signal in SIGNAL_NAMES.items()}
    columns = {}  # in ``SCORES`` order
    for score, begin in begins.items():
        if (fused := progress if score == PROGRESS else begin) in names:
            columns[score] = fused
            columns |= {score + name.removeprefix(begin): name for name in names if name.startswith(f"{begin}.")}
    return columns


@dataclass(frozen=True)
class LabelFile:
    """An existing label file, which a run may replace.

    provenance: writer, dataset and recipe; empty: another program wrote the labels
    digests: digest by episode number
    """

    path: Path
    provenance: Mapping[str, Any]
    digests: Mapping[int, str]

    @property
    def checkpoint(self) -> str:
        """Where the checkpoint comes from, else its digest; empty: unknown."""
        checkpoint = self.provenance.get("checkpoint") or {}
        return str(checkpoint.get("source") or checkpoint.get("weights_digest") or "")

    @property
    def warning(self) -> str | None:
        """As in ``rfm_client.ModelInfo``, about the checkpoint."""
        return ModelInfo.warning_of((self.provenance.get("checkpoint") or {}).get("weights_digest"))

    @classmethod
    def read(cls, path: Path) -> LabelFile:
        """Read what a file's metadata say."""
        metadata: Mapping[bytes, bytes] = {}
        with suppress(DatasetError):
            metadata = _metadata(path)
        provenance = _provenance(metadata)
        is_own = str(provenance.get("writer")).startswith("rfm-client") and isinstance(provenance.get("dataset"), dict)
        by_number = parsed_object(metadata.get(EPISODES_KEY)) if is_own else {}
        digests = {int(number): str(digest) for number, digest in by_number.items() if number.isdecimal()}
        return cls(path, provenance if is_own else {}, digests)

    def check(self, plan: Plan) -> None:
        """Raise DatasetError unless the plan reproduces all labels in the file by the same recipe."""
        there, now = _settings(_recipe(self.provenance)), _settings(_recipe(plan.provenance()))
        if "advantage" not in self.provenance:  # the plan may add it
            now = {name: value for name, value in now.items() if not name.startswith("advantage.")}
        names = [name for name in dict.fromkeys([*now, *there]) if there.get(name) != now.get(name)]
        differ = "; ".join(f"{name}: {there.get(name, 'none')} there, {now.get(name, 'none')} now" for name in names)
        got = differ if self.provenance else "labels of another program"
        is_same = not differ and bool(self.digests)
        require(self.path, is_same, "no labels, or those of the same recipe", got or "others")
        planned = {item.episode.index: item.digest for item in plan.items}
        lost = sorted(self.digests.keys() - planned.keys())
        got = f"those of {listed(lost)}, too"
        require(self.path, not lost, "labels of the chosen episodes alone", got)
        changed = sorted(number for number, digest in self.digests.items() if planned[number] != digest)
        why = "whose frames or rows have changed, or their tasks (copy videos with their times: cp -p)"
        got = f"others for {listed(changed)}, {why}"
        require(self.path, not changed, "labels of the episodes as they are now", got)


def _recipe(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """The provenance without the dataset's source: episode digests identify the dataset."""
    dataset = provenance.get("dataset", {})
    return {**provenance, "writer": None, "dataset": {"kind": dataset.get("kind")}}


def _settings(document: Mapping[str, Any]) -> dict[str, str]:
    """Settings by path, for messages, for example ``sampling.frames``."""
    settings: dict[str, str] = {}
    for name, value in document.items():
        if isinstance(value, Mapping):
            settings |= {f"{name}.{inner}": text for inner, text in _settings(value).items()}
        elif value is not None:
            settings[name] = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return settings
