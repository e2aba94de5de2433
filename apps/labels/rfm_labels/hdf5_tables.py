# SPDX-License-Identifier: MIT
"""Read labels in HDF5 files, where a path such as ``demos.hdf5/rfm`` names the labels ``rfm``. Needs h5py.

A label file has ``data/demo_<i>/<name>_<column>``, float32 [T], and attributes of ``data`` on how they were made. So
has a dataset's own file with labels in place.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rfm_client import Float32Array
from rfm_labels.datasets.faults import DatasetError, require
from rfm_labels.datasets.hdf5 import is_hdf5
from rfm_labels.datasets.hdf5_contents import attribute, demonstrations, members_of, opened_hdf5
from rfm_labels.metadata import PROGRESS, SCORES

# Endings of attributes, after the labels' name.
PROVENANCE, EPISODES, COST, BLANK = "provenance", "episodes", "cost", "blank_cameras"

_OWN_FILE = re.compile(r"(.+)\.([\w-]+)_rewards\.hdf5")


def own_file(folder: Path, stem: str, name: str) -> Path:
    """Return the path of a separate label file. stem: stem of the dataset's file"""
    return folder / f"{stem}.{name}_rewards.hdf5"


def dataset_stem(file: Path) -> str:
    """Return the stem of the dataset's file for a label file or the dataset's file itself."""
    match = _OWN_FILE.fullmatch(file.name)
    return match[1] if match else file.stem


def stored_in(path: Path) -> Path:
    """Return the file that holds labels: ``demos.hdf5`` of ``demos.hdf5/rfm``, else the path itself."""
    return path.parent if is_hdf5(path.parent) else path


def labels_in(file: Path) -> list[Path]:
    """Return the paths of all labels in an HDF5 file, by name. Raises DatasetError for another file."""
    with opened_hdf5(file) as opened:
        attributes = getattr(opened.get("data"), "attrs", {})
        names = [key.removesuffix(f"_{PROVENANCE}") for key in attributes if key.endswith(f"_{PROVENANCE}")]
    return [file / name for name in sorted(names)]


def find_in_hdf5(root: Path) -> list[Path]:
    """Return the labels of an HDF5 dataset, or of the only one in a folder: in place, then beside.

    Raises DatasetError for a folder with labels of several HDF5 datasets, or an unreadable file.
    """
    folder = root.parent if root.is_file() else root
    stored = [file for file in sorted(folder.glob("[!.]*")) if is_hdf5(file)]
    of_dataset = [file for file in stored if root.is_dir() or dataset_stem(file) == dataset_stem(root)]
    found = [labels for file in of_dataset for labels in labels_in(file)]
    stems = sorted({dataset_stem(labels.parent) for labels in found})
    got = f"{', '.join(stems)}: name one of the files, not the folder"
    require(folder, len(stems) < 2, "labels of one dataset", got)
    return found


def of_hdf5(path: Path) -> tuple[Path, str] | None:
    """Return the HDF5 file and the name of labels; None for a path outside HDF5 files.

    Raises DatasetError for a file of several labels, or without labels.
    """
    if is_hdf5(path.parent):
        return path.parent, path.name
    if not is_hdf5(path):
        return None
    found = labels_in(path)
    require(path, len(found) == 1, "labels of one name", f"{', '.join(map(str, found)) or 'none'}")
    return path, found[0].name


def full_path(path: Path) -> Path:
    """Return the path of labels with their name if they are in an HDF5 file. Raises DatasetError as ``of_hdf5``."""
    in_hdf5 = of_hdf5(path)
    return path if in_hdf5 is None else in_hdf5[0] / in_hdf5[1]


def columns_in(group: Any, name: str) -> list[str]:
    """Return the paths of the labels of this name in all demonstrations, without longer names that begin with it."""
    column = re.compile(rf"{re.escape(name)}_({'|'.join(SCORES)})(\..+)?")
    demos = members_of(group)
    return [f"{demo}/{each}" for demo in demos for each in members_of(demos[demo]) if column.fullmatch(each)]


def read_attribute(file: Path, name: str, what: str) -> Any:
    """Return the text in one of the attributes of labels; None: it is missing. Raises DatasetError."""
    with opened_hdf5(file) as opened:
        return attribute(getattr(opened.get("data"), "attrs", {}), f"{name}_{what}")


def read_hdf5_table(file: Path, name: str, *, episode: int | None = None) -> Any:
    """Return labels as a pyarrow Table with the parts' column names, without ``index``. Raises DatasetError.

    episode: only this episode's rows; None: all
    """
    import pyarrow as pa

    tables = []
    with opened_hdf5(file) as opened:
        for number, (demo, stored) in demonstrations(file, opened).items():
            found = columns_in({demo: stored}, name) if episode in (None, number) else []
            columns = {column.removeprefix(f"{demo}/{name}_"): stored.get(column.partition("/")[2]) for column in found}
            if columns:
                scores = _scores(f"{file}: data/{demo}: {name}", columns)
                length = len(scores[PROGRESS])
                identity = {"episode_index": np.full(length, number, np.int64), "frame_index": np.arange(length)}
                tables.append(pa.table({**identity, **scores}))
    if not tables:
        identity = {"episode_index": np.empty(0, np.int64), "frame_index": np.empty(0, np.int64)}
        return pa.table({**identity, PROGRESS: np.empty(0, np.float32)})
    names: Sequence[str] = tables[0].column_names
    for table in tables:
        got = ", ".join(table.column_names)
        require(f"{file}: {name}", set(table.column_names) == set(names), f"the columns {', '.join(names)}", got)
    return pa.concat_tables([table.select(names) for table in tables])


def _scores(where: str, columns: dict[str, Any]) -> dict[str, Float32Array]:
    """The scores of one demonstration, float32 [T] each."""
    length = (getattr(columns.get(PROGRESS), "shape", None) or (0,))[0]
    for column, stored in columns.items():
        is_score = getattr(stored, "shape", None) == (length,) and stored.dtype.kind == "f" and length > 0
        got = getattr(stored, "shape", None) or "others"
        require(f"{where}_{column}", is_score, "one number per progress value", got)
    if PROGRESS not in columns:
        raise DatasetError.at(where, "progress", ", ".join(columns))
    return {column: stored[()].astype(np.float32) for column, stored in columns.items()}
