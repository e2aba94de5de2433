# SPDX-License-Identifier: MIT
"""Labels of an HDF5 dataset as HDF5: ``data/demo_<i>/<name>_progress`` and so on, float32 [T]. Needs h5py.

They go to a file of their own beside the dataset, or into the dataset's file if the caller asks for that.
"""

from __future__ import annotations

import re
import uuid
from pathlib import Path
from typing import Any

from rfm_client.data.datasets.hdf5 import Hdf5Dataset
from rfm_client.data.datasets.protocol import DatasetError, digest_of
from rfm_client.labelling.episode_scores import PROGRESS, SUCCESS
from rfm_client.labelling.finished_episodes import Parts
from rfm_client.labelling.plan import Plan
from rfm_client.labelling.sidecars import IDENTITY, canonical_json


def sibling(dataset: Hdf5Dataset, folder: Path, name: str) -> Path:
    """The file of labels of its own."""
    return folder / f"{dataset.file.stem}.{name}_rewards.hdf5"


def check_hdf5_replaceable(file: Path, plan: Plan, name: str) -> None:
    """Raises DatasetError if the file holds labels of this name that are not this plan's.

    What a run of this plan has left in the file, when it was killed, is this plan's.
    """
    import h5py

    if not file.exists():
        return
    try:
        with h5py.File(file, "r") as opened:
            group = opened.get("data", {})
            attributes = getattr(group, "attrs", {})
            known, begun = attributes.get(_provenance(name)), attributes.get(_unfinished(name))
            has_labels = known is not None or bool(_labels(group, name))
    except OSError as error:
        raise DatasetError.at(file, "an HDF5 file", str(error)) from error
    if begun is not None:
        is_own, got = begun == _digest(plan), "labels of another run, which did not end"
    else:
        is_own, got = not has_labels or known == _document(plan), "labels of another provenance"
    if not is_own:
        advice = "choose another --name, or --overwrite"
        raise DatasetError.at(file, f"no labels {name}, or of the same provenance", f"{got}: {advice}")


def write_hdf5(file: Path, plan: Plan, parts: Parts, name: str, *, in_place: bool) -> None:
    """Writes the labels of all parts. A file of its own is put in its place when it is whole.

    in_place: the file is the dataset's own: all labels of this name give way to those of the plan. A run that is killed
        leaves some of them, and the attribute ``<name>_unfinished`` in place of the provenance; the same command then
        goes on

    Raises DatasetError for a part that is missing.
    """
    import h5py

    written = file if in_place else file.with_name(f".{file.name}.{uuid.uuid4().hex}")
    try:
        with h5py.File(written, "r+" if in_place else "w") as opened:
            group = opened.require_group("data")
            _begin(group, plan, name)
            for item in plan.items:
                table = parts.read(item)
                demo = group.require_group(item.episode.name)
                for column in (each for each in table.column_names if each not in IDENTITY):
                    demo.create_dataset(f"{name}_{column}", data=table[column].to_numpy())
            _end(group, plan, name)
        written.replace(file)
    finally:
        if not in_place:
            written.unlink(missing_ok=True)


def _begin(group: Any, plan: Plan, name: str) -> None:
    """Deletes all labels of this name. From before the first is gone, the file says that they are not whole."""
    group.attrs[_unfinished(name)] = _digest(plan)
    group.attrs.pop(_provenance(name), None)
    group.file.flush()
    for label in _labels(group, name):
        del group[label]


def _end(group: Any, plan: Plan, name: str) -> None:
    group.file.flush()  # the provenance comes after all that it is about
    group.attrs[_provenance(name)] = _document(plan)
    del group.attrs[_unfinished(name)]


def _labels(group: Any, name: str) -> list[str]:
    """Paths of the labels of this name, and of no other that begins alike, in all demonstrations."""
    column = re.compile(rf"{re.escape(name)}_({PROGRESS}|{SUCCESS})(\..+)?")
    demos = {demo: content for demo, content in group.items() if hasattr(content, "keys")}
    return [f"{demo}/{each}" for demo, content in demos.items() for each in content if column.fullmatch(each)]


def _document(plan: Plan) -> str:
    return canonical_json(plan.provenance()).decode()


def _digest(plan: Plan) -> str:
    return digest_of([canonical_json(plan.provenance())])


def _provenance(name: str) -> str:
    return f"{name}_provenance"


def _unfinished(name: str) -> str:
    return f"{name}_unfinished"
