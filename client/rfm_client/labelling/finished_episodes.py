# SPDX-License-Identifier: MIT
"""One file for each finished episode, in a folder or behind any URL that fsspec knows. Needs pyarrow and fsspec.

A part is there whole or not at all, and its name says what it is made of: so whoever finds it may use it.
"""

from __future__ import annotations

import io
import os
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rfm_client.data.datasets.protocol import DatasetError
from rfm_client.labelling.episode_scores import Columns
from rfm_client.labelling.plan import Item

DIGEST_KEY = b"rfm.digest"
SUFFIX = ".parquet"

_TEMPORARY = ".tmp-"


class Parts:
    """The parts in one place.

    url: a folder, or a URL of fsspec, for example ``s3://bucket/folder``
    """

    def __init__(self, url: str) -> None:
        try:
            import pyarrow  # noqa: F401
            from fsspec.core import url_to_fs
            from fsspec.implementations.local import LocalFileSystem
        except ImportError as error:
            raise ImportError('labelling needs pyarrow and fsspec: pip install "./client[label]"') from error
        self.url = url
        self.fs, self.root = url_to_fs(url)
        self.is_local = isinstance(self.fs, LocalFileSystem)
        with self.writing():
            self.fs.makedirs(self.root, exist_ok=True)

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Makes an OSError say what to do; a FileExistsError stays as it is."""
        try:
            yield
        except FileExistsError:
            raise
        except OSError as error:
            got = f"{error.strerror or error}: make room or name another place with --parts, and run the same command"
            raise OSError(f"{self.url}: expected a folder that can be written, got {got}") from error

    def path(self, name: str) -> str:
        """The path of a file in the file system."""
        return f"{self.root}/{name}"

    def finished(self, items: Sequence[Item]) -> set[str]:
        """Keys of the items whose parts are there."""
        self.fs.invalidate_cache()
        names = {path.rpartition("/")[2] for path in self.fs.ls(self.root, detail=False)}
        return {item.key for item in items if item.key + SUFFIX in names}

    def has(self, item: Item) -> bool:
        """Whether the item's part is there."""
        return bool(self.fs.exists(self.path(item.key + SUFFIX)))

    def write(self, item: Item, columns: Columns) -> None:
        """Writes the item's part, or leaves none. Raises OSError."""
        import pyarrow as pa
        from pyarrow import parquet

        count, first = item.episode.num_frames, item.episode.first_index
        identity = {
            "index": np.arange(first, first + count, dtype=np.int64),
            "episode_index": np.full(count, item.episode.index, np.int64),
            "frame_index": np.arange(count, dtype=np.int64),
        }
        table = pa.table({**identity, **columns}).replace_schema_metadata({DIGEST_KEY: item.digest})
        content = io.BytesIO()
        parquet.write_table(table, content)
        with self.writing():
            self.put(item.key + SUFFIX, content.getvalue())

    def read(self, item: Item) -> Any:
        """The item's table. Raises DatasetError for a part that is missing or not whole."""
        import pyarrow as pa
        from pyarrow import parquet

        path = self.path(item.key + SUFFIX)
        try:
            # without Arrow's threads: one that let go of Python's bytes as the interpreter ends would abort it
            part = parquet.ParquetFile(pa.BufferReader(self.fs.cat_file(path)), pre_buffer=False)
            table = part.read(use_threads=False)
        except FileNotFoundError as error:
            raise DatasetError.at(path, "a part for each episode", "none") from error
        except (OSError, pa.ArrowException) as error:
            raise DatasetError.at(path, "a whole part", f"{error}: delete it, and run the same command") from error
        digest = (table.schema.metadata or {}).get(DIGEST_KEY, b"").decode()
        if digest != item.digest or table.num_rows != item.episode.num_frames:
            got = f"another, of {table.num_rows} frames: delete it, and run the same command"
            raise DatasetError.at(path, f"the part of {item.episode.name}", got)
        return table

    def put(self, name: str, content: bytes) -> None:
        """Writes a file that others see whole or not at all. Raises OSError."""
        if not self.is_local:
            self.fs.pipe_file(self.path(name), content)  # object stores show no half of an object
            return
        temporary = Path(self.path(f"{_TEMPORARY}{uuid.uuid4().hex}"))
        try:
            with temporary.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(self.path(name))
        finally:
            temporary.unlink(missing_ok=True)
