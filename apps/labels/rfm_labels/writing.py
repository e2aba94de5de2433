# SPDX-License-Identifier: MIT
"""Write labels: one part per finished episode, then Parquet files for the whole dataset. Needs pyarrow and fsspec.

A part is a Parquet file in a folder or at an fsspec URL. Writes are atomic. The file name contains a digest over
everything that decides the labels, so any run may reuse the part.

``<name>_progress.parquet``: the format that LeRobot's reward-aligned behaviour cloning and the Hub's visualizer read.
Columns: int64 ``index``, ``episode_index``, ``frame_index``, then float32 ``progress_sparse``, ``success``, one set per
camera, and on request ``advantage``. If an episode has several tasks, ``progress`` restarts with each task, and
``progress_sparse`` adds up the gains. If the model skips frames, ``progress`` is NaN there, and ``progress_sparse`` is
interpolated.

``reward_signals/<name>.parquet``: LeRobot's frame signals (schema version 1), as its open pull requests propose them.
Columns: the same int64 columns, then float32 ``reward.<name>.progress``, ``reward.<name>.success_probability``, and one
set per camera. The metadata describes each score column.
"""

from __future__ import annotations

import fcntl
import io
import os
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np

from rfm_client import Float32Array
from rfm_labels.advantage import most_steps, recap_advantages
from rfm_labels.datasets.faults import DatasetError, require
from rfm_labels.metadata import (
    PROGRESS,
    REMAINING,
    SCORES,
    SUCCESS,
    Columns,
    blank_from_metadata,
    blank_to_metadata,
    canonical_json,
    skipping_in,
    values_of,
)
from rfm_labels.plan import Item, Plan

IDENTITY = ("index", "episode_index", "frame_index")  # columns in every label table
PROGRESS_ENDING = "_progress.parquet"
PROVENANCE_KEY = b"rfm.provenance"
SIGNALS_PROVENANCE_KEY = b"lerobot.reward_scoring.provenance"
EPISODES_KEY = b"rfm.episodes"  # digest per episode: a later run compares them to see whether the labels still hold
NAMES_KEY = b"rfm.names"  # by number, of episodes that have names of their own
FILL_KEY = b"rfm.progress_sparse_fill"  # absent if the model skipped no frame
SIGNAL_NAMES = {**{name: name for name in SCORES}, SUCCESS: "success_probability", REMAINING: "remaining_time_s"}
_POTENTIAL, _IS_SCORED, _ADVANTAGE = "potential", "is_inference_frame", "advantage"
_DERIVED = {  # further signals and what they mean
    _ADVANTAGE: "Progress gained over the horizon, less the time it took (RECAP)",
    _POTENTIAL: "Minus the remaining seconds",
    _IS_SCORED: "1 where the model scored the frame itself",
}

Form: TypeAlias = tuple[Mapping[str, str], Mapping[bytes, bytes]]  # a file's columns by part column, and its metadata

_DIGEST_KEY = b"rfm.digest"
_SUFFIX = ".parquet"
_ROWS_AT_A_TIME = 2**17  # per row group
_TOTAL = "total"  # progress summed over an episode's tasks


class Parts:
    """The parts written by a labelling run.

    url: a folder, or an fsspec URL, for example ``s3://bucket/folder``

    Raises ImportError if a package is missing, OSError if the place is not writable.
    """

    def __init__(self, url: str) -> None:
        try:
            import pyarrow  # noqa: F401
            from fsspec.core import url_to_fs
            from fsspec.implementations.local import LocalFileSystem
        except ImportError as error:
            raise ImportError(f"labelling: {error}: pip install ./client ./apps/labels") from error
        self.url = url
        self._fs, self._root = url_to_fs(url)
        self._is_local = isinstance(self._fs, LocalFileSystem)
        with self._writing():
            self._fs.makedirs(self._root, exist_ok=True)

    def finished(self, items: Sequence[Item]) -> set[str]:
        """Return the keys of items whose parts exist."""
        return self.keys() & {item.key for item in items}

    def keys(self) -> set[str]:
        """Return the keys of all parts that exist."""
        self._fs.invalidate_cache()
        names = (path.rpartition("/")[2] for path in self._fs.ls(self._root, detail=False))
        return {name.removesuffix(_SUFFIX) for name in names if name.endswith(_SUFFIX)}

    def has(self, item: Item) -> bool:
        """True if the item's part exists."""
        return bool(self._fs.exists(self._path(item)))

    def write(self, item: Item, columns: Columns, blank: Mapping[str, int]) -> None:
        """Write the item's part atomically. Raises OSError.

        columns, blank: as ``episode_scores`` returns them
        """
        import pyarrow as pa
        from pyarrow import parquet

        count, first = item.episode.num_frames, item.episode.first_index
        rows = (np.arange(first, first + count), np.full(count, item.episode.index), np.arange(count))
        identity = {name: values.astype(np.int64) for name, values in zip(IDENTITY, rows, strict=True)}
        about = blank_to_metadata({camera: {item.episode.index: highest} for camera, highest in blank.items()})
        table = pa.table({**identity, **columns}).replace_schema_metadata({_DIGEST_KEY: item.digest, **about})
        content = io.BytesIO()
        parquet.write_table(table, content)
        with self._writing():
            if self._is_local:
                with whole_files(Path(self._path(item))) as (file,):
                    file.write_bytes(content.getvalue())
            else:
                self._fs.pipe_file(self._path(item), content.getvalue())  # object stores never show partial objects

    def read(self, item: Item) -> Any:
        """Read the item's part as a pyarrow Table. Raises DatasetError if it is missing, damaged or another item's."""
        import pyarrow as pa
        from pyarrow import parquet

        path = self._path(item)
        try:
            # no Arrow threads: one that releases Python bytes during interpreter shutdown aborts the process
            part = parquet.ParquetFile(pa.BufferReader(self._fs.cat_file(path)), pre_buffer=False)
            table = part.read(use_threads=False)
        except FileNotFoundError as error:
            raise DatasetError.at(path, "a part for each episode", "none") from error
        except (OSError, pa.ArrowException) as error:
            raise DatasetError.at(path, "a whole part", f"{error}: delete it, and run the same command") from error
        digest = (table.schema.metadata or {}).get(_DIGEST_KEY, b"").decode()
        is_own = digest == item.digest and table.num_rows == item.episode.num_frames
        got = f"another, of {table.num_rows} frames: delete it, and run the same command"
        require(path, is_own, f"the part of {item.episode.name}", got)
        return table

    def read_all(self, plan: Plan) -> Any:
        """Return a pyarrow Table with the rows for all items in the plan, in order, and the blank cameras as metadata.

        Raises DatasetError if a part is missing, damaged or out of order, or has other columns than the first.
        """
        import pyarrow as pa

        tables: list[Any] = []
        blank: dict[str, dict[int, int]] = {}
        following = -1
        for item in plan.items:
            table, first = self.read(item), item.episode.first_index
            require(item.episode.name, first > following, f"rows after {following}", first)
            following = first + item.episode.num_frames - 1
            names, own = (tables or [table])[0].column_names, table.column_names
            require(item.episode.name, own == names, f"the columns {', '.join(names)}", ", ".join(own))
            for camera, highest in blank_from_metadata(table.schema.metadata).items():
                blank.setdefault(camera, {}).update(highest)
            tables.append(table.replace_schema_metadata(None))
        return pa.concat_tables(tables).replace_schema_metadata(blank_to_metadata(blank))

    def _path(self, item: Item) -> str:
        return f"{self._root}/{item.key}{_SUFFIX}"

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Add the remedy to an OSError."""
        try:
            yield
        except OSError as error:
            got = f"{error.strerror or error}: make room or name another place with --parts, and run the same command"
            raise OSError(f"{self.url}: expected a folder that can be written, got {got}") from error


@contextmanager
def whole_files(*targets: Path) -> Iterator[list[Path]]:
    """Yield a temporary file for each target. After the block, sync all files to disk, then replace the targets.

    If the block raises or a write fails, all targets stay unchanged. If a replacement fails, the OSError names the
    targets that are new already.
    """
    with ExitStack() as temporary:
        written = [temporary.enter_context(_temporary(target)) for target in targets]
        yield written
        for file in written:
            with file.open("rb") as whole:
                os.fsync(whole.fileno())
        for number, (file, target) in enumerate(zip(written, targets, strict=True)):
            try:
                file.replace(target)
            except OSError as error:
                new = "".join(f"; {each} is new already" for each in targets[:number])
                raise OSError(f"{target}: cannot be replaced: {error.strerror}{new}") from error


@contextmanager
def _temporary(target: Path) -> Iterator[Path]:
    """Yield an empty file beside the target, and remove it after the block, unless it was moved.

    The name is fixed, so that a repeated run overwrites what a killed run left. It is a random one while another run
    writes the same target, or if the file system has no locks.
    """
    file = _temporary_name(target)
    with ExitStack() as files:
        opened = files.enter_context(file.open("ab"))
        if not _locked(file, opened):
            file = target.with_name(f".{target.name}.{uuid.uuid4().hex}.tmp")
            opened = files.enter_context(file.open("xb"))
        try:
            yield file
        finally:
            if _is_at(file, opened):  # else it was moved, and the name may be another run's by now
                file.unlink()


def _temporary_name(target: Path) -> Path:
    return target.with_name(f".{target.name}.{os.getuid()}.tmp")  # this user can overwrite it


def _locked(file: Path, opened: IO[bytes]) -> bool:
    """Lock the open file until it is closed, even by a kill. Return False if another run has it or has moved it."""
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # the file system has no locks, so nobody uses the name
        file.unlink(missing_ok=True)
        return False
    return _is_at(file, opened)


def remove_files(files: Sequence[Path]) -> None:
    """Delete files, unless a run is writing one of them. Raises DatasetError, OSError."""
    with ExitStack() as held:
        for file in files:
            temporary = held.enter_context(_temporary(file))
            got = "one, or a file system without locks: wait, or delete the file yourself"
            require(file, temporary == _temporary_name(file), "no run that writes it", got)
        for file in files:
            file.unlink()


def _is_at(file: Path, opened: IO[bytes]) -> bool:
    """True if the open file has this path."""
    try:
        return os.path.samestat(file.stat(), os.fstat(opened.fileno()))
    except FileNotFoundError:
        return False


def _progress_form(plan: Plan, columns: Sequence[str]) -> Form:
    """The form of a progress file with these part columns."""
    checkpoint = plan.recipe.checkpoint
    model = checkpoint.source or checkpoint.weights_digest
    metadata = {
        b"reward_model_path": (f"{model}@{checkpoint.revision}" if checkpoint.revision else model).encode(),
        PROVENANCE_KEY: canonical_json(plan.provenance()),
    }
    named = {name: name for name in columns}
    if skipping_in(columns):
        metadata[FILL_KEY] = b"linear"
    advantage = {} if plan.horizon is None else {_ADVANTAGE: _ADVANTAGE}
    if skipping_in(columns) or _has_several_tasks(plan):
        return {_TOTAL: "progress_sparse", **named, **advantage}, metadata
    return {**named, PROGRESS: "progress_sparse", **advantage}, metadata


def _with_totals(labels: Any, plan: Plan) -> Any:
    """Return the labels, a table from ``Parts.read_all``, with all columns that the label files need.

    Reward-aligned behaviour cloning weights a frame by the progress between two frames, or 0 if progress falls.
    Progress restarts when an episode's task changes, so ``progress_sparse`` sums the gains over all tasks. A frame
    without progress would get weight 1, so skipped frames are filled.
    """
    import pyarrow as pa

    derived = {}
    if REMAINING in labels.column_names:
        seconds = values_of(labels[REMAINING])
        derived = {_POTENTIAL: -seconds, _IS_SCORED: np.ones_like(seconds)}
    skipping = skipping_in(labels.column_names)
    if skipping is not None:
        derived[_IS_SCORED] = np.isfinite(values_of(labels[skipping])).astype(np.float32)
    for name, values in derived.items():
        labels = labels.append_column(name, pa.array(values))
    if plan.horizon is not None:
        labels = labels.append_column(_ADVANTAGE, pa.array(_advantages(values_of(labels[PROGRESS]), plan)))
    if not (skipping or _has_several_tasks(plan)):
        return labels
    progress = values_of(labels[PROGRESS])
    total, begin = progress.copy(), 0
    for item in plan.items:
        end = begin + item.episode.num_frames
        for first, _ in item.episode.tasks[1:]:
            own = slice(begin + first, end)
            begun = np.nan_to_num(progress[own.start])  # NaN before the first answer if the model compares frames
            total[own] = progress[own] - begun + total[own.start - 1]
        if skipping:
            total[begin:end] = _filled(total[begin:end])
        begin = end
    return labels.append_column(_TOTAL, pa.array(total))


def _advantages(progress: Float32Array, plan: Plan) -> Float32Array:
    """Return the advantages of all frames, float32 [T], each within its stretch of frames with one task."""
    assert plan.horizon is not None
    steps = most_steps(plan.episodes)
    stretches = [stretch for item in plan.items for stretch in item.episode.stretches]
    starts = np.cumsum([0, *(num_frames for _, num_frames in stretches)])
    return np.concatenate(
        [
            recap_advantages(_filled(progress[start : start + num_frames]), plan.horizon, steps[task])
            for start, (task, num_frames) in zip(starts, stretches, strict=False)
        ]
    )


def _filled(progress: Float32Array) -> Float32Array:
    """Interpolate an episode's progress, [T], linearly between answers, like LeRobot's ``interpolate_progress``.

    The model measures its first answer from the first frame, whose progress is 0.
    """
    known = np.isfinite(progress)
    known[0], frames = True, np.arange(len(progress))
    filled: Float32Array = np.interp(frames, frames[known], np.nan_to_num(progress[known])).astype(np.float32)
    return filled


def _has_several_tasks(plan: Plan) -> bool:
    return any(item.episode.tasks for item in plan.items)


def _signals_form(plan: Plan, columns: Sequence[str], name: str) -> Form:
    """The form of a frame signal file with these part columns."""
    signals = {}
    for column in columns:
        score, dot, camera = column.partition(".")
        signals[column] = f"reward.{name}.{SIGNAL_NAMES[score]}{dot}{camera}"
    if REMAINING in signals:
        signals[_POTENTIAL] = f"reward.{name}.{_POTENTIAL}"
    skipping = skipping_in(signals)
    if plan.horizon is not None:
        signals[_ADVANTAGE] = f"reward.{name}.{_ADVANTAGE}"
    if REMAINING in signals or skipping is not None:
        signals[_IS_SCORED] = f"reward.{name}.{_IS_SCORED}"
    metadata = {
        "format": b"lerobot.frame_signals",
        "schema_version": b"1",
        "provenance": canonical_json(plan.provenance()),
        "descriptors": canonical_json({signal: _descriptor(column, skipping) for column, signal in signals.items()}),
        "episode_indices": canonical_json([item.episode.index for item in plan.items]),
    }
    ordered = dict(sorted(signals.items(), key=lambda signal: signal[1]))
    named = {f"lerobot.reward_scoring.{key}".encode(): value for key, value in metadata.items()}
    return ordered, named


def _descriptor(column: str, skipping: str | None) -> dict[str, Any]:
    """Return a signal's metadata. skipping: as ``skipping_in`` returns it."""
    name, _, camera = column.partition(".")
    score = SCORES.get(name)
    meaning = _DERIVED[name] if score is None else score.meaning
    has_gaps = skipping is not None and name in (PROGRESS, skipping)
    return {
        "description": meaning + (f", seen by {camera}" if camera else ""),
        "direction": "higher" if score is None or score.higher_is_better else "lower",
        "bounds": [None, None] if score is None else [*score.bounds],
        "unit": None,
        "missing_values": "nan" if has_gaps else "forbidden",
        "allow_nan": has_gaps,  # same meaning, in another revision of the proposal
    }


def write_labels(labels: Any, plan: Plan, progress: Sequence[Path], signals: Sequence[Path], name: str) -> list[Path]:
    """Write the labels to new files, read them back, then move them into place one by one. Return all paths.

    labels: table from ``Parts.read_all``
    progress, signals: files in each format
    name: reward name, in the signals' column names

    Raises OSError if a write fails or a file reads back differently; existing files then stay unchanged.
    """
    import pyarrow as pa
    from pyarrow import parquet

    columns = [each for each in labels.column_names if each not in IDENTITY]
    forms = [(path, _progress_form(plan, columns)) for path in progress]
    forms += [(path, _signals_form(plan, columns, name)) for path in signals]
    shared = {EPISODES_KEY: canonical_json(plan.digests()), **(labels.schema.metadata or {})}
    if names := plan.names:
        shared[NAMES_KEY] = canonical_json(names)
    labels = _with_totals(labels, plan)
    for path, _ in forms:
        path.parent.mkdir(parents=True, exist_ok=True)
    with whole_files(*(path for path, _ in forms)) as files:
        for file, (path, (named, metadata)) in zip(files, forms, strict=True):
            own = labels.select([*IDENTITY, *named]).rename_columns([*IDENTITY, *named.values()])
            fields = [pa.field(field.name, field.type, nullable=False) for field in own.schema]
            schema = pa.schema(fields, metadata={**metadata, **shared})
            table = pa.Table.from_arrays(own.columns, schema=schema)  # a cast would import pyarrow.compute
            parquet.write_table(table, file, row_group_size=_ROWS_AT_A_TIME)
            if not _holds(file, table):
                raise OSError(f"{path}: expected the labels that were written, read others")
    return [path for path, _ in forms]


def _holds(file: Path, table: Any) -> bool:
    """True if the file's rows, values and metadata equal the table's."""
    from pyarrow import ArrowException, parquet

    try:
        read = parquet.ParquetFile(file).read()
    except ArrowException:
        return False
    pairs = zip(read.columns, table.columns, strict=False)
    return read.schema.equals(table.schema, check_metadata=True) and all(
        np.array_equal(values_of(one), values_of(other), equal_nan=True) for one, other in pairs
    )
