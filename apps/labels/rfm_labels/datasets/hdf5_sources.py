# SPDX-License-Identifier: MIT
"""Find missing sources of virtual HDF5 datasets, in place of which h5py silently reads zeros. Needs h5py."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

_BLOCKS = "%b"  # in a source's name: HDF5 then counts only the sources that exist


def lacking(dataset: Any) -> str:
    """Return the file, dataset or frames missing from a virtual dataset or its sources; empty if nothing is."""
    if not dataset.is_virtual:
        return ""
    sources = dataset.virtual_sources()
    lacks = next(filter(None, (_lacking_source(dataset, each) for each in sources)), "")
    is_whole = sum(_num_values(each.vspace) for each in sources) >= dataset.size
    return lacks or ("" if is_whole else "a source for each frame")


def _lacking_source(dataset: Any, source: Any) -> str:
    import h5py

    if _BLOCKS in source.file_name:
        return ""
    if source.file_name == ".":
        return _lacking_in(dataset.file, source)
    found = next((file for file in _places(dataset, source.file_name) if file.is_file()), None)
    if found is None:
        return f"the file {source.file_name}"
    try:
        with h5py.File(found, "r") as opened:
            return _lacking_in(opened, source)
    except OSError:
        return f"the HDF5 file {found}"


def _lacking_in(opened: Any, source: Any) -> str:
    from h5py import h5s

    stored = opened.get(source.dset_name)
    if not hasattr(stored, "shape"):
        return f"{source.dset_name} in {opened.filename}"
    is_all = source.src_space.get_select_type() == h5s.SEL_ALL  # HDF5 refuses a source of another size
    if is_all or _num_values(source.src_space) == math.inf:
        return lacking(stored)
    _, last = source.src_space.get_select_bounds()
    is_whole = len(last) == stored.ndim and all(index < size for index, size in zip(last, stored.shape, strict=True))
    return lacking(stored) if is_whole else f"{last[0] + 1} frames of {source.dset_name} in {opened.filename}"


def _num_values(space: Any) -> float:
    """Return the number of selected values; infinite for a selection without an end."""
    try:
        return int(space.get_select_npoints())
    except RuntimeError:
        return math.inf


def _places(dataset: Any, name: str) -> list[Path]:
    """The paths at which HDF5 looks for a source file."""
    file = Path(dataset.file.filename)
    prefixes = os.environ.get("HDF5_VDS_PREFIX", "").replace("${ORIGIN}", str(file.parent)).split(":")
    folders = [*map(Path, filter(None, prefixes)), file.parent, Path(), file.resolve().parent]
    return [folder / each for folder in folders for each in (name, Path(name).name)]
