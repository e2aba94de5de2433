# SPDX-License-Identifier: MIT
"""Checks of values and files, and lists of names for messages."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from rfm_client.contract.errors import InvalidValueError, LocatedError

_LFS_POINTER = b"version https://git-lfs"  # how each begins


def require(
    where: object, condition: bool, expected: str, got: object, error: type[LocatedError] = InvalidValueError
) -> None:
    """Raise ``error`` unless the condition holds."""
    if not condition:
        raise error.at(where, expected, got)


def first_names(names: Collection[object], most: int = 5) -> str:
    """Return the first names, and the number of the others."""
    more = len(names) - most
    return ", ".join(map(str, list(names)[:most])) + (f" and {more} more" if more > 0 else "")


def git_lfs_pointer(content: Path | bytes) -> str:
    """Return what to say of a file that git cloned without git-lfs; empty for all others.

    content: the file, or its first bytes
    """
    if isinstance(content, Path):
        with content.open("rb") as file:
            content = file.read(len(_LFS_POINTER))
    is_pointer = content.startswith(_LFS_POINTER)
    return "Git LFS's note of where it is; `git lfs pull` fetches it" if is_pointer else ""
