# SPDX-License-Identifier: MIT
"""Rerun's recordings, read back with Rerun's own reader: ``rerun.dataframe``, or ``rerun.chunk`` of newer releases."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import rerun

try:
    from rerun.chunk import RrdReader
except ImportError:
    RrdReader = None


def entities(file: Path) -> set[str]:
    if RrdReader is not None:
        return {chunk.entity_path for chunk in RrdReader(file).stream()}
    return {column.entity_path for column in rerun.dataframe.load_recording(file).schema().component_columns()}


def logged(file: Path, timeline: str, entity: str, component: str) -> tuple[list[Any], list[Any]]:
    """Return a component's times and values in order."""
    columns = _of_chunks if RrdReader is not None else _of_view
    pairs = [
        (time, value[0])
        for times, values in columns(file, timeline, entity, component)
        for time, value in zip(times.cast("int64").to_pylist(), values.to_pylist(), strict=True)
        if value is not None
    ]
    pairs.sort(key=lambda pair: pair[0])
    return [time for time, _ in pairs], [value for _, value in pairs]


def _of_view(file: Path, timeline: str, entity: str, component: str) -> Iterator[tuple[Any, Any]]:
    view = rerun.dataframe.load_recording(file).view(index=timeline, contents=entity)
    table = view.select(timeline, f"{entity}:{component}").read_all()
    yield table.column(0), table.column(1)


def _of_chunks(file: Path, timeline: str, entity: str, component: str) -> Iterator[tuple[Any, Any]]:
    kind = f"rerun.components.{component}".encode()
    for chunk in RrdReader(file).stream():
        if chunk.entity_path == entity and timeline in chunk.timeline_names:
            batch = chunk.to_record_batch()
            for column in batch.schema:
                if (column.metadata or {}).get(b"rerun:component_type") == kind:
                    yield batch[timeline], batch[column.name]
