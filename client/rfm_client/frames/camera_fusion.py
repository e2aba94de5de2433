# SPDX-License-Identifier: MIT
"""Functions that fuse the scores of several cameras."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

Fuse: TypeAlias = Literal["mean", "min", "max"]
FUSES: dict[Fuse, Callable[..., npt.NDArray[np.float32]]] = {"mean": np.mean, "min": np.min, "max": np.max}
