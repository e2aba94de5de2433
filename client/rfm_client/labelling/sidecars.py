# SPDX-License-Identifier: MIT
"""The files of labels that training reads: one row a frame, in the dataset's order. Needs pyarrow.

``<name>_progress.parquet``: the form of LeRobot's reward-aligned behaviour cloning and of the Hub's visualizer. Columns
int64 ``index``, ``episode_index``, ``frame_index``, then float32 ``progress_sparse``, ``success``, and each camera's.

``reward_signals/<name>.parquet``: the form of LeRobot's frame signals (schema version 1), as its open pull requests
propose it. The same first columns, then ``reward.<name>.progress``, ``reward.<name>.success_probability``, and each
camera's, with a description of each in the metadata.
"""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rfm_client.data.datasets.protocol import DatasetError
from rfm_client.labelling.episode_scores import PROGRESS, SUCCESS, Columns
from rfm_client.labelling.finished_episodes import Parts
from rfm_client.labelling.label_files import read_label_table
from rfm_client.labelling.labelled_before import LabelFile
from rfm_client.labelling.plan import Item, Plan

IDENTITY = ("index", "episode_index", "frame_index")
ROWS_AT_A_TIME = 2**17  # of one row group
PROVENANCE_KEY = b"rfm.provenance"
EPISODES_KEY = b"rfm.episodes"  # the digest of each, so that a later run knows whether its labels still hold

_SIGNALS = b"lerobot.reward_scoring."
SIGNALS_PROVENANCE_KEY = _SIGNALS + b"provenance"
_DESCRIPTIONS = {PROGRESS: "Share of the task that is done", SUCCESS: "Probability that the task is done"}
_SIGNAL_NAMES = {PROGRESS: "progress", SUCCESS: "success_probability"}


@dataclass(frozen=True)
class Sidecar:
    """One file of labels.

    columns: name of each column of scores, by its name in the parts
    metadata: of the Parquet schema
    """

    path: Path
    columns: Mapping[str, str]
    metadata: Mapping[bytes, bytes]


def progress_file(path: Path, plan: Plan, columns: Sequence[str]) -> Sidecar:
    """The progress file for these columns of the parts."""
    checkpoint = plan.recipe.checkpoint
    model = checkpoint.source or checkpoint.weights_digest
    if checkpoint.revision:
        model += f"@{checkpoint.revision}"
    metadata = {
        b"reward_model_path": model.encode(),
        PROVENANCE_KEY: canonical_json(plan.provenance()),
        EPISODES_KEY: canonical_json(plan.digests()),
    }
    return Sidecar(path, {name: "progress_sparse" if name == PROGRESS else name for name in columns}, metadata)


def signals_file(path: Path, plan: Plan, columns: Sequence[str], name: str) -> Sidecar:
    """The file of frame signals for these columns of the parts."""
    signals = {column: _signal(name, column) for column in columns}
    metadata = {
        "format": b"lerobot.frame_signals",
        "schema_version": b"1",
        "provenance": canonical_json(plan.provenance()),
        "descriptors": canonical_json({signals[column]: _descriptor(column) for column in columns}),
        "episode_indices": canonical_json([item.episode.index for item in plan.items]),
    }
    ordered = dict(sorted(signals.items(), key=lambda signal: signal[1]))
    named = {_SIGNALS + key.encode(): value for key, value in metadata.items()}
    return Sidecar(path, ordered, {**named, EPISODES_KEY: canonical_json(plan.digests())})


def write_sidecars(plan: Plan, parts: Parts, sidecars: Sequence[Sidecar]) -> None:
    """Streams the parts into all files, and puts each in its place when it is whole.

    Raises DatasetError for a missing part, or one with other columns than the first, and OSError: then no file changes.
    """
    if not sidecars:
        return
    temporary = [sidecar.path.with_name(f".{sidecar.path.name}.{uuid.uuid4().hex}") for sidecar in sidecars]
    try:
        for file in temporary:
            file.parent.mkdir(parents=True, exist_ok=True)
        _stream(plan, parts, dict(zip(temporary, sidecars, strict=True)))
        for file, sidecar in zip(temporary, sidecars, strict=True):
            file.replace(sidecar.path)
    except OSError as error:
        got = f"{error}: make room, or name another folder with --output and this one's --parts {parts.url}"
        raise OSError(f"{sidecars[0].path.parent}: expected to write the labels, got {got}") from error
    finally:
        for file in temporary:
            file.unlink(missing_ok=True)


def part_columns(plan: Plan, parts: Parts) -> list[str]:
    """The columns of scores that the parts have."""
    return [name for name in parts.read(plan.items[0]).column_names if name not in IDENTITY]


def parquet_labels(path: Path, option: str = "--name") -> LabelFile | None:
    """The labels in the file of this path; None: there is none. option: chooses another path"""
    from pyarrow import ArrowException, parquet

    if not path.exists():
        return None
    try:
        metadata = parquet.read_schema(path).metadata or {}
    except (OSError, ArrowException):
        metadata = {}
    provenance = metadata.get(PROVENANCE_KEY, metadata.get(SIGNALS_PROVENANCE_KEY))
    found = LabelFile.of(path, provenance, metadata.get(EPISODES_KEY), lambda items: _read(path, items))
    return replace(found, option=option)


def canonical_json(document: Any) -> bytes:
    """The document as JSON, the same bytes for the same document."""
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def _read(path: Path, items: Sequence[Item]) -> Iterator[tuple[Item, Columns]]:
    table, columns = read_label_table(path)
    names = {
        PROGRESS: columns.progress,
        **{f"{PROGRESS}.{camera}": name for camera, name in columns.progress_of.items()},
    }
    if columns.success is not None:
        names |= {
            SUCCESS: columns.success,
            **{f"{SUCCESS}.{camera}": name for camera, name in columns.success_of.items()},
        }
    episodes = table["episode_index"].to_numpy()
    for item in items:
        start, end = np.searchsorted(episodes, [item.episode.index, item.episode.index + 1]).tolist()
        rows = table.slice(start, end - start)
        yield item, {column: rows[name].to_numpy() for column, name in names.items()}


def _stream(plan: Plan, parts: Parts, sidecars: Mapping[Path, Sidecar]) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    writers: dict[Path, Any] = {}
    try:
        for table in _row_groups(plan, parts):
            for file, sidecar in sidecars.items():
                renamed = table.select([*IDENTITY, *sidecar.columns]).rename_columns(
                    [*IDENTITY, *sidecar.columns.values()]
                )
                if file not in writers:
                    fields = [pa.field(field.name, field.type, nullable=False) for field in renamed.schema]
                    writers[file] = parquet.ParquetWriter(file, pa.schema(fields, metadata=dict(sidecar.metadata)))
                writers[file].write_table(renamed.cast(writers[file].schema), row_group_size=ROWS_AT_A_TIME)
    finally:
        for writer in writers.values():
            writer.close()


def _row_groups(plan: Plan, parts: Parts) -> Iterator[Any]:
    """The rows of all parts in order, about ROWS_AT_A_TIME together."""
    import pyarrow as pa

    together: list[Any] = []
    names: list[str] | None = None
    following = -1
    for item in plan.items:
        table = parts.read(item)
        names = names or table.column_names
        if table.column_names != names:
            raise DatasetError.at(item.episode.name, f"the columns {', '.join(names)}", ", ".join(table.column_names))
        if item.episode.first_index <= following:
            raise DatasetError.at(item.episode.name, f"rows after {following}", str(item.episode.first_index))
        following = item.episode.first_index + item.episode.num_frames - 1
        together.append(table.replace_schema_metadata(None))
        if sum(map(len, together)) >= ROWS_AT_A_TIME:
            yield pa.concat_tables(together)
            together = []
    if together:
        yield pa.concat_tables(together)


def _signal(name: str, column: str) -> str:
    score, _, camera = column.partition(".")
    return f"reward.{name}.{_SIGNAL_NAMES[score]}" + (f".{camera}" if camera else "")


def _descriptor(column: str) -> dict[str, Any]:
    score, _, camera = column.partition(".")
    return {
        "description": _DESCRIPTIONS[score] + (f", seen by {camera}" if camera else ""),
        "direction": "higher",
        "bounds": [0.0, 1.0],
        "unit": None,
        "missing_values": "forbidden",
        "allow_nan": False,  # how another revision of the proposal says the same
    }
