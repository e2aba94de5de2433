# SPDX-License-Identifier: MIT
"""Parts: a Parquet file for each finished episode, in a folder or at an fsspec URL. Needs pyarrow and fsspec.

A part exists whole or not at all. Its name has the digest of everything that decides its labels, so any run may use it.
"""

from __future__ import annotations

import io
import os
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rfm_labels import blank_cameras
from rfm_labels.datasets.faults import DatasetError, require
from rfm_labels.episode_scores import Columns
from rfm_labels.plan import Item, Plan

IDENTITY = ("index", "episode_index", "frame_index")  # columns of every table of labels

_DIGEST_KEY = b"rfm.digest"
_SUFFIX = ".parquet"


class Parts:
    """The parts of a labelling run. Raises ImportError for a missing package, OSError for a place without write access.

    url: a folder, or an fsspec URL, for example ``s3://bucket/folder``
    """

    def __init__(self, url: str) -> None:
        try:
            import pyarrow  # noqa: F401
            from fsspec.core import url_to_fs
            from fsspec.implementations.local import LocalFileSystem
        except ImportError as error:
            raise ImportError("labelling needs pyarrow and fsspec: pip install ./client ./apps/labels") from error
        self.url = url
        self._fs, self._root = url_to_fs(url)
        self._is_local = isinstance(self._fs, LocalFileSystem)
        with self._writing():
            self._fs.makedirs(self._root, exist_ok=True)

    def finished(self, items: Sequence[Item]) -> set[str]:
        """Return the keys of the items whose parts exist."""
        self._fs.invalidate_cache()
        names = {path.rpartition("/")[2] for path in self._fs.ls(self._root, detail=False)}
        return {item.key for item in items if item.key + _SUFFIX in names}

    def has(self, item: Item) -> bool:
        """True if the item's part exists."""
        return bool(self._fs.exists(self._path(item)))

    def write(self, item: Item, columns: Columns, blank: Mapping[str, int]) -> None:
        """Write the item's part, whole or not at all. Raises OSError. columns, blank: as in ``EpisodeScores``"""
        import pyarrow as pa
        from pyarrow import parquet

        count, first = item.episode.num_frames, item.episode.first_index
        rows = (np.arange(first, first + count), np.full(count, item.episode.index), np.arange(count))
        identity = {name: values.astype(np.int64) for name, values in zip(IDENTITY, rows, strict=True)}
        about = blank_cameras.to_metadata(blank_cameras.by_camera([(item.episode.index, blank)]))
        table = pa.table({**identity, **columns}).replace_schema_metadata({_DIGEST_KEY: item.digest, **about})
        content = io.BytesIO()
        parquet.write_table(table, content)
        with self._writing():
            if self._is_local:
                with whole_file(Path(self._path(item))) as file:
                    file.write_bytes(content.getvalue())
            else:
                self._fs.pipe_file(self._path(item), content.getvalue())  # object stores show only whole objects

    def read(self, item: Item) -> Any:
        """Return the item's part, a pyarrow Table. Raises DatasetError if it is missing, damaged or of another item."""
        import pyarrow as pa
        from pyarrow import parquet

        path = self._path(item)
        try:
            # no Arrow threads: a thread that releases Python's bytes while the interpreter ends aborts the process
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
        """Return a pyarrow Table with the rows of all items of a plan, in order, and the blank cameras as metadata.

        Raises DatasetError for a part that is missing, damaged, out of order, or has other columns than the first part.
        """
        import pyarrow as pa

        tables: list[Any] = []
        blank: list[tuple[int, Mapping[str, int]]] = []
        following = -1
        for item in plan.items:
            table, name, first = self.read(item), item.episode.name, item.episode.first_index
            names = (tables or [table])[0].column_names
            require(name, table.column_names == names, f"the columns {', '.join(names)}", ", ".join(table.column_names))
            require(name, first > following, f"rows after {following}", first)
            following = first + item.episode.num_frames - 1
            told = blank_cameras.from_metadata(table.schema.metadata)
            blank += [(episode, {camera: value}) for camera, of in told.items() for episode, value in of.items()]
            tables.append(table.replace_schema_metadata(None))
        about = blank_cameras.to_metadata(blank_cameras.by_camera(blank))
        return pa.concat_tables(tables).replace_schema_metadata(about)

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
def whole_file(target: Path) -> Iterator[Path]:
    """Yield a file to write, which replaces ``target`` in one step after the block, but not after an exception."""
    written = target.with_name(f".tmp-{uuid.uuid4().hex}")
    try:
        yield written
        with written.open("rb") as whole:
            os.fsync(whole.fileno())
        written.replace(target)
    finally:
        written.unlink(missing_ok=True)
