# SPDX-License-Identifier: MIT
"""Write and read Parquet label files: a row for each frame, in the dataset's order. Needs pyarrow.

``<name>_progress.parquet``: the format of LeRobot's reward-aligned behaviour cloning and of the Hub's visualizer.
Columns: int64 ``index``, ``episode_index``, ``frame_index``, then float32 ``progress_sparse``, ``success``, and those
of each camera. If an episode has several tasks, ``progress`` is each frame's own, and ``progress_sparse`` the sum of
what all tasks have gained.

``reward_signals/<name>.parquet``: LeRobot's frame signals (schema version 1), as its open pull requests propose them.
Columns: the same int64 columns, then float32 ``reward.<name>.progress``, ``reward.<name>.success_probability``, and
those of each camera. The metadata describes each score column.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client import Float32Array
from rfm_labels.blank_cameras import BLANK_KEY, BlankCameras, from_metadata
from rfm_labels.cost import Cost
from rfm_labels.datasets.lerobot_rows import INFO_FILE
from rfm_labels.datasets.protocol import SIGNALS_FOLDER, DatasetError, require
from rfm_labels.episode_scores import PROGRESS, SCORES, SUCCESS, Columns
from rfm_labels.finished_episodes import IDENTITY, whole_file
from rfm_labels.hdf5_tables import (
    BLANK,
    COST,
    PROVENANCE,
    find_in_hdf5,
    of_hdf5,
    read_attribute,
    read_hdf5_table,
)
from rfm_labels.labelled_before import LabelFile, parsed_object
from rfm_labels.plan import Item, Plan

PROGRESS_ENDING = "_progress.parquet"
PROVENANCE_KEY = b"rfm.provenance"
SIGNALS_PROVENANCE_KEY = b"lerobot.reward_scoring.provenance"

_EPISODES_KEY = b"rfm.episodes"  # each episode's digest, by which a later run sees if its labels still hold
_COST_KEY = b"rfm.cost"  # apart from the provenance, which is equal for equal runs
_ROWS_AT_A_TIME = 2**17  # in a row group
_OWN_NAME = "rfm"  # default of ``LabelOptions.name``
_PROGRESS_NAMES = ("progress", "progress_sparse", "progress_dense")
_TOTAL = "total"  # progress added up over the tasks of an episode
_SIGNAL_NAMES = {**{name: name for name in SCORES}, SUCCESS: "success_probability"}


@dataclass(frozen=True)
class Sidecar:
    """A Parquet label file to write.

    columns: each score column's name in the file, by its name in the parts
    metadata: of the Parquet schema
    """

    path: Path
    columns: Mapping[str, str]
    metadata: Mapping[bytes, bytes]


def progress_file(path: Path, plan: Plan, columns: Sequence[str], cost: Cost | None) -> Sidecar:
    """Return the progress file for these columns of the parts. cost: None: unknown"""
    checkpoint = plan.recipe.checkpoint
    model = checkpoint.source or checkpoint.weights_digest
    metadata = {
        b"reward_model_path": (f"{model}@{checkpoint.revision}" if checkpoint.revision else model).encode(),
        PROVENANCE_KEY: canonical_json(plan.provenance()),
        **_of_run(plan, cost),
    }
    named = {name: name for name in columns}
    if _has_several_tasks(plan):
        return Sidecar(path, {_TOTAL: "progress_sparse", **named}, metadata)
    return Sidecar(path, {**named, PROGRESS: "progress_sparse"}, metadata)


def with_totals(labels: Any, plan: Plan) -> Any:
    """Return the labels with all columns that the label files need. labels: table of ``Parts.read_all``

    Reward-aligned behaviour cloning weights a frame by the difference of two frames' progress, and 0 if it falls. Where
    an episode's task changes, progress begins anew, so the sum of all tasks' gains takes its place.
    """
    import pyarrow as pa

    if not _has_several_tasks(plan):
        return labels
    progress = labels[PROGRESS].to_numpy()
    total, begin = progress.copy(), 0
    for item in plan.items:
        end = begin + item.episode.num_frames
        for first, _ in item.episode.tasks[1:]:
            own = slice(begin + first, end)
            total[own] = progress[own] - progress[own.start] + total[own.start - 1]
        begin = end
    return labels.append_column(_TOTAL, pa.array(total))


def _has_several_tasks(plan: Plan) -> bool:
    return any(item.episode.tasks for item in plan.items)


def signals_file(path: Path, plan: Plan, columns: Sequence[str], name: str, cost: Cost | None) -> Sidecar:
    """Return the file of frame signals for these columns of the parts. cost: None: unknown"""
    signals = {}
    for column in columns:
        score, dot, camera = column.partition(".")
        signals[column] = f"reward.{name}.{_SIGNAL_NAMES[score]}{dot}{camera}"
    metadata = {
        "format": b"lerobot.frame_signals",
        "schema_version": b"1",
        "provenance": canonical_json(plan.provenance()),
        "descriptors": canonical_json({signals[column]: _descriptor(column) for column in columns}),
        "episode_indices": canonical_json([item.episode.index for item in plan.items]),
    }
    ordered = dict(sorted(signals.items(), key=lambda signal: signal[1]))
    named = {f"lerobot.reward_scoring.{key}".encode(): value for key, value in metadata.items()}
    return Sidecar(path, ordered, {**named, **_of_run(plan, cost)})


def _of_run(plan: Plan, cost: Cost | None) -> dict[bytes, bytes]:
    """Return the metadata that both formats share."""
    digests = {_EPISODES_KEY: canonical_json(plan.digests())}
    return digests if cost is None else {**digests, _COST_KEY: cost.json()}


def _descriptor(column: str) -> dict[str, Any]:
    name, _, camera = column.partition(".")
    score = SCORES[name]
    return {
        "description": score.meaning + (f", seen by {camera}" if camera else ""),
        "direction": "higher" if score.higher_is_better else "lower",
        "bounds": [*score.bounds],
        "unit": None,
        "missing_values": "forbidden",
        "allow_nan": False,  # the same in another revision of the proposal
    }


def write_sidecars(labels: Any, sidecars: Sequence[Sidecar]) -> None:
    """Write new files with the labels, then put all in place. Raises OSError; a failed write changes no file.

    labels: table of ``Parts.read_all``
    """
    import pyarrow as pa
    from pyarrow import parquet

    with ExitStack() as whole:
        for sidecar in sidecars:
            own = labels.select([*IDENTITY, *sidecar.columns])
            own = own.rename_columns([*IDENTITY, *sidecar.columns.values()])
            fields = [pa.field(field.name, field.type, nullable=False) for field in own.schema]
            schema = pa.schema(fields, metadata={**sidecar.metadata, **(labels.schema.metadata or {})})
            sidecar.path.parent.mkdir(parents=True, exist_ok=True)
            file = whole.enter_context(whole_file(sidecar.path))
            parquet.write_table(own.cast(schema), file, row_group_size=_ROWS_AT_A_TIME)


def parquet_labels(path: Path, option: str = "--name") -> LabelFile | None:
    """Return the labels in the file; None: no file. ``option``: the command-line option that chooses another path."""
    from pyarrow import ArrowException, parquet

    if not path.exists():
        return None
    try:
        metadata = parquet.read_schema(path).metadata or {}
    except (OSError, ArrowException):
        metadata = {}
    provenance = metadata.get(PROVENANCE_KEY, metadata.get(SIGNALS_PROVENANCE_KEY))
    cost = Cost.parse(metadata.get(_COST_KEY))
    blank = from_metadata(metadata)
    digests = metadata.get(_EPISODES_KEY)
    return LabelFile.of(path, provenance, digests, lambda items: _read(path, items), option, cost, blank)


def _read(path: Path, items: Sequence[Item]) -> Iterator[tuple[Item, Columns]]:
    table = read_label_table(path)
    episodes = table["episode_index"].to_numpy()
    names = [name for name in table.column_names if name not in IDENTITY]
    for item in items:
        start, end = np.searchsorted(episodes, [item.episode.index, item.episode.index + 1]).tolist()
        rows = table.slice(start, end - start)
        yield item, {name: rows[name].to_numpy() for name in names}


def canonical_json(document: Any) -> bytes:
    """Return the document as JSON; equal documents give equal bytes."""
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


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
    """

    frames: npt.NDArray[np.int64]
    fused: Curve
    cameras: Mapping[str, Curve]


def find_label_files(root: Path) -> list[Path]:
    """Return the label files of a dataset, those with the default name first.

    root: the dataset's folder, or HDF5 file

    For labels in both Parquet formats, return only the progress file. Labels in HDF5 are paths such as
    ``demos.hdf5/rfm`` (in place) and ``demos.rfm_rewards.hdf5/rfm``. Raises DatasetError for a folder with labels of
    several HDF5 datasets.
    """
    in_hdf5 = [] if (root / INFO_FILE).is_file() else find_in_hdf5(root)  # a LeRobot dataset has none
    if root.is_file():
        return sorted(in_hdf5, key=lambda file: file.name != _OWN_NAME)
    progress = sorted(root.glob(f"*{PROGRESS_ENDING}"))
    named = {file.name.removesuffix(PROGRESS_ENDING) for file in progress}
    signals = [file for file in sorted((root / SIGNALS_FOLDER).glob("*.parquet")) if file.stem not in named]
    files = [file for file in (*progress, *signals, *in_hdf5) if not file.name.startswith(".")]
    return sorted(files, key=lambda file: file.name.removesuffix(PROGRESS_ENDING) != _OWN_NAME)


def read_label_table(file: Path, *, episode: int | None = None) -> Any:
    """Return a label file of any format as a pyarrow Table, with the parts' column names. Raises DatasetError.

    Score columns: those of ``episode_columns``, as far as the file has them.

    file: Parquet, or HDF5 as ``find_label_files`` returns it

    episode: only this episode's rows; None: all
    """
    from pyarrow import ArrowException, parquet

    if in_hdf5 := of_hdf5(file):
        return read_hdf5_table(*in_hdf5, episode=episode)
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
    if in_hdf5 := of_hdf5(file):
        return Cost.parse(read_attribute(*in_hdf5, COST))
    return Cost.parse(_metadata(file).get(_COST_KEY))


def read_blank(file: Path) -> BlankCameras:
    """Return the cameras that show nothing, as the metadata of a file's labels tell them. Raises DatasetError."""
    if in_hdf5 := of_hdf5(file):
        blank = read_attribute(*in_hdf5, BLANK)
        return from_metadata({BLANK_KEY: blank} if blank else {})
    return from_metadata(_metadata(file))


def read_provenance(file: Path) -> dict[str, Any]:
    """Return writer, dataset and recipe of a label file, as far as it tells them. Raises DatasetError."""
    if in_hdf5 := of_hdf5(file):
        told = read_attribute(*in_hdf5, PROVENANCE)
    else:
        metadata = _metadata(file)
        told = metadata.get(PROVENANCE_KEY, metadata.get(SIGNALS_PROVENANCE_KEY))
    return parsed_object(told)


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
    return EpisodeLabels(table["frame_index"].to_numpy(), curve(), {camera: curve(f".{camera}") for camera in cameras})


def _score_columns(file: Path, names: Sequence[str]) -> dict[str, str]:
    """Score columns by their names in the parts. Raises DatasetError without progress or ``episode_index``."""
    require(file, "episode_index" in names, "the column episode_index", ", ".join(names))
    own = next((name for name in _PROGRESS_NAMES if name in names), None)
    signal = next((name for name in names if name.startswith("reward.") and name.endswith(".progress")), None)
    progress = own or signal
    if progress is None:
        raise DatasetError.at(file, "a column of progress", ", ".join(names))
    before = progress.removesuffix("progress")
    begins = {score: score if own is not None else before + signal for score, signal in _SIGNAL_NAMES.items()}
    columns = {}  # in the order of ``episode_columns``
    for score, begin in begins.items():
        if (fused := progress if score == PROGRESS else begin) in names:
            columns[score] = fused
            columns |= {score + name.removeprefix(begin): name for name in names if name.startswith(f"{begin}.")}
    return columns
