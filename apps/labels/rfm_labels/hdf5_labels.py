# SPDX-License-Identifier: MIT
"""Write labels of an HDF5 dataset in HDF5: ``data/demo_<i>/<name>_<column>``, float32 [T], for T frames. Needs h5py.

The labels have a file of their own, or with ``in_place`` are in the dataset's file.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfm_labels.datasets.faults import require
from rfm_labels.datasets.hdf5_contents import attribute, opened_hdf5
from rfm_labels.hdf5_tables import BLANK, COST, EPISODES, PROVENANCE, columns_in
from rfm_labels.in_place import BusyError, rewrite
from rfm_labels.label_files import LabelFile
from rfm_labels.metadata import BLANK_KEY, SCORES, Columns, Cost, blank_from_metadata, canonical_json
from rfm_labels.plan import Item, Plan
from rfm_labels.writing import IDENTITY, whole_file

_DATASET_BYTES, _FILE_BYTES = 2**12, 2**20  # upper bounds of HDF5's overhead: for one column, for all attributes
_REMEDY = "make room, or leave --in-place away: then the labels are in a file of their own"


def hdf5_labels(file: Path, name: str) -> LabelFile | None:
    """Return the labels of this name in the file; None: no such labels. Raises DatasetError if it is no HDF5 file."""
    with opened_hdf5(file) as opened:
        group = opened.get("data")
        attributes = getattr(group, "attrs", {})
        provenance, digests, cost, blank = (
            attribute(attributes, f"{name}_{each}") for each in (PROVENANCE, EPISODES, COST, BLANK)
        )
        if provenance is None and not columns_in(group, name):
            return None
    return LabelFile.of(
        file,
        provenance,
        digests,
        lambda items: _read(file, name, items),
        cost=Cost.parse(cost),
        blank=blank_from_metadata({BLANK_KEY: blank} if blank else {}),
    )


def check_room(file: Path, plan: Plan) -> None:
    """Raise DatasetError if the disk has no room for a copy of the dataset's file with labels."""
    target = file.resolve()
    needed, free = target.stat().st_size + _most_bytes(plan), shutil.disk_usage(target.parent).free
    expected = f"{needed} bytes of free disk, for a copy that takes its place when it is whole"
    require(file, free >= needed, expected, f"{free}: {_REMEDY}")


@dataclass(frozen=True)
class Hdf5Labels:
    """Labels to write. table: of ``Parts.read_all``; cost: None: unknown"""

    plan: Plan
    table: Any
    name: str
    cost: Cost | None

    def write(self, file: Path) -> None:
        """Write the labels to a new file, then replace ``file`` by it. Raises OSError, with ``file`` unchanged."""
        import h5py

        with _unchanged(file, "make room, and run the same command"), whole_file(file.resolve()) as written:
            h5py.File(written, "w").close()
            self._put(written, is_dataset=False)

    def write_in_place(self, file: Path, note: Callable[[str], None]) -> None:
        """Replace a dataset's file by a copy with these labels. Raises OSError, with ``file`` unchanged.

        Labels of this name in it are replaced. Whatever others write into the file meanwhile is kept.

        note: called with a line about each wait
        """
        target = file.resolve()  # otherwise the copy would replace a link, not its target
        with _unchanged(file, _REMEDY):
            rewrite(target, lambda written: self._put(written, is_dataset=True), note)

    def _put(self, written: Path, *, is_dataset: bool) -> None:
        import h5py

        _reserve(written, _most_bytes(self.plan))
        with h5py.File(written, "r+") as opened:
            group = opened.require_group("data")
            for label in columns_in(group, self.name):
                del group[label]
            start = 0
            for item in self.plan.items:
                rows = self.table.slice(start, item.episode.num_frames)
                start += item.episode.num_frames
                if is_dataset:
                    self._check(group, item)
                demo = group.require_group(item.episode.name)
                for column in (column for column in rows.column_names if column not in IDENTITY):
                    demo.create_dataset(f"{self.name}_{column}", data=rows[column].to_numpy())
            group.attrs[f"{self.name}_{PROVENANCE}"] = canonical_json(self.plan.provenance()).decode()
            group.attrs[f"{self.name}_{EPISODES}"] = canonical_json(self.plan.digests()).decode()
            blank = (self.table.schema.metadata or {}).get(BLANK_KEY)
            for what, text in ((COST, None if self.cost is None else self.cost.json()), (BLANK, blank)):
                group.attrs.pop(f"{self.name}_{what}", None)
                if text is not None:
                    group.attrs[f"{self.name}_{what}"] = text.decode()

    def _check(self, group: Any, item: Item) -> None:
        """Raise DatasetError if another program has removed the demonstration, or changed the number of frames."""
        videos = [group.get(f"{item.episode.name}/obs/{camera}") for camera in self.plan.recipe.cameras]
        lengths = {(getattr(video, "shape", None) or (0,))[0] for video in videos}
        got = "another, changed while it was labelled: run the same command again"
        require(item.episode.name, lengths == {item.episode.num_frames}, f"{item.episode.num_frames} frames", got)


@contextmanager
def _unchanged(file: Path, advice: str) -> Iterator[None]:
    """Add the remedy to an OSError, or to a RuntimeError, with which h5py reports some failed writes."""
    try:
        yield
    except BusyError:
        raise
    except (OSError, RuntimeError) as error:
        got = f"{error}, and no file has changed: {advice}"
        raise OSError(f"{file}: expected to write the labels, got {got}") from error


def _most_bytes(plan: Plan) -> int:
    """An upper bound of the labels' size in the file."""
    num_columns = len(SCORES) * (1 + len(plan.recipe.cameras))
    return _FILE_BYTES + num_columns * (4 * plan.num_frames + _DATASET_BYTES * len(plan.items))


def _reserve(file: Path, num_bytes: int) -> None:
    """Append zeros, so that a full disk raises OSError here: h5py breaks down if the disk fills while it writes.

    HDF5 keeps only the bytes that it needs.
    """
    with file.open("ab") as opened:
        while num_bytes > 0:
            num_bytes -= opened.write(bytes(min(num_bytes, _FILE_BYTES)))


def _read(file: Path, name: str, items: Sequence[Item]) -> Iterator[tuple[Item, Columns]]:
    with opened_hdf5(file) as opened:
        for item in items:
            demo = opened.get(f"data/{item.episode.name}")
            labels = columns_in({"": demo}, name)
            yield item, {label[len(f"/{name}_") :]: demo[label[1:]][()] for label in labels}
