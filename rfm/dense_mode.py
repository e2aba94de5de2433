# SPDX-License-Identifier: MIT
"""Dense mode: frame t of a trajectory is scored on its prefix 0..t, sampled to K frames."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def prefix_indices(num_frames: int, frame_steps: int) -> npt.NDArray[np.int64]:
    """int64 [T, K], the frames that stand for each prefix 0..t.

    K positions evenly from 0 to t, truncated to whole frames, as the original server samples them.
    """
    return np.stack([np.linspace(0, t, frame_steps).astype(np.int64) for t in range(num_frames)])
