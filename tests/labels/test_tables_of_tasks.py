# SPDX-License-Identifier: MIT
"""LeRobot v3.0's table of tasks, whose columns depend on the writer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from pyarrow import parquet

from rfm_labels.datasets.lerobot_rows import read_sentences

TABLES: dict[str, tuple[dict[str, list[Any]], list[str]]] = {
    "an index without a name": ({"task_index": [0, 1], "__index_level_0__": ["a b", "c d"]}, ["a b", "c d"]),
    "a column of sentences": ({"task": ["a b", "c d"], "task_index": [0, 1]}, ["a b", "c d"]),
    "further columns": ({"task_index": [0, 1], "task": ["a b", "c d"], "robot": ["x", "y"]}, ["a b", "c d"]),
    "another name": ({"task_index": [0, 1], "sentence": ["a b", "c d"]}, ["a b", "c d"]),
}


@pytest.mark.parametrize(("columns", "expected"), TABLES.values(), ids=TABLES)
def test_a_table_of_tasks_is_read_as_its_writers_name_its_columns(
    tmp_path: Path, columns: dict[str, list[Any]], expected: list[str]
) -> None:
    (tmp_path / "meta").mkdir()
    parquet.write_table(pa.table(columns), tmp_path / "meta" / "tasks.parquet")
    assert list(read_sentences(tmp_path / "meta" / "tasks.parquet").values()) == expected
