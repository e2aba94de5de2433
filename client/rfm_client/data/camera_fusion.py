# SPDX-License-Identifier: MIT
"""How the scores of several cameras become one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

Fuse: TypeAlias = Literal["mean", "min", "max"]
FUSES: dict[Fuse, Callable[..., npt.NDArray[np.float32]]] = {"mean": np.mean, "min": np.min, "max": np.max}


def check_fuse(fuse: str) -> None:
    """Raises ValueError for what is no way to fuse scores."""
    if fuse not in FUSES:
        raise ValueError(f"fuse: expected one of {', '.join(FUSES)}, got {fuse!r}")


def checked_cameras(cameras: Sequence[str]) -> tuple[str, ...]:
    """The names of cameras, each once. Raises ValueError."""
    if isinstance(cameras, str):
        raise ValueError(f"cameras: expected a sequence of names, got {cameras!r}")
    if len(set(cameras)) < len(cameras):
        raise ValueError(f"cameras: expected names that differ, got {list(cameras)}")
    return tuple(cameras)
