# SPDX-License-Identifier: MIT
"""Conversion of numpy arrays to tensors."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor


def as_tensor(array: npt.NDArray[Any]) -> Tensor:
    """The array as a tensor; a copy only where torch cannot share its memory (read-only, reversed)."""
    return torch.from_numpy(np.require(array, requirements=("C", "W")))
