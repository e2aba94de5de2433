# SPDX-License-Identifier: MIT
"""Labels of an HDF5 dataset as HDF5: ``data/demo_<i>/<name>_progress`` and so on, float32 [T]. Needs h5py.

They go to a file of their own beside the dataset, or into the dataset's file if the caller asks for that.
"""

from __future__ import annotations

import uuid
from pathlib import Path
from typing import Any

from rfm_client.data.datasets.hdf5 import Hdf5Dataset
from rfm_client.data.datasets.protocol import DatasetError
from rfm_client.labelling.finished_episodes import Parts
from rfm_client.labelling.plan import Plan
from rfm_client.labelling.sidecars import IDENTITY, canonical_json


def sibling(dataset: Hdf5Dataset, folder: Path, name: str) -> Path:
    """The file of labels of its own."""
    return folder / f"{dataset.file.stem}.{name}_rewards.hdf5"


def check_hdf5_replaceable(file: Path, plan: Plan, name: str) -> None:
    """Raises DatasetError if the file holds labels of this name that are not this plan's."""
    import h5py

    if not file.exists():
        return
    try:
        with h5py.File(file, "r") as opened:
            group = opened.get("data", {})
            known = getattr(group, "attrs", {}).get(_provenance(name))
            has_labels = known is not None or any(f"{name}_progress" in demo for demo in group.values())
    except OSError as error:
        raise DatasetError.at(file, "an HDF5 file", str(error)) from error
    if has_labels and known != canonical_json(plan.provenance()).decode():
        got = "labels of another provenance: choose another --name, or --overwrite"
        raise DatasetError.at(file, f"no labels {name}, or of the same provenance", got)


def write_hdf5(file: Path, plan: Plan, parts: Parts, name: str, *, in_place: bool) -> None:
    """Writes the labels of all parts. A file of its own is put in its place when it is whole.

    in_place: the file is the dataset's own, to which labels are added; a run that is killed then leaves some of them,
        and the same command goes on

    Raises DatasetError for a part that is missing.
    """
    import h5py

    written = file if in_place else file.with_name(f".{file.name}.{uuid.uuid4().hex}")
    try:
        with h5py.File(written, "r+" if in_place else "w") as opened:
            group = opened.require_group("data")
            for item in plan.items:
                table = parts.read(item)
                demo = group.require_group(item.episode.name)
                for column in (each for each in table.column_names if each not in IDENTITY):
                    _replace(demo, f"{name}_{column}", table[column].to_numpy())
            group.attrs[_provenance(name)] = canonical_json(plan.provenance()).decode()
        written.replace(file)
    finally:
        if not in_place:
            written.unlink(missing_ok=True)


def _replace(group: Any, name: str, values: Any) -> None:
    if name in group:
        del group[name]
    group.create_dataset(name, data=values)


def _provenance(name: str) -> str:
    return f"{name}_provenance"
