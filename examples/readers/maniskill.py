# SPDX-License-Identifier: MIT
"""ManiSkill trajectories with pictures: replay_trajectory -o rgb --save-traj. Needs h5py.

rfm-client label demos/StackCube-v1 --task "stack the cubes" --reader examples/readers/maniskill.py:episodes
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import h5py

from rfm_client import UInt8Array
from rfm_labels import Episode


def episodes(folder: Path) -> Iterator[Episode]:
    """Yield the trajectories of each file in order. The observation after the last action is a frame, too."""
    for file in sorted(folder.glob("*.h5")):
        with h5py.File(file) as opened:
            for name in sorted(opened, key=lambda name: (len(name), name)):
                cameras = [each for each, stored in opened[f"{name}/obs/sensor_data"].items() if "rgb" in stored]
                frames = {each: partial(pixels, file, f"{name}/obs/sensor_data/{each}/rgb") for each in cameras}
                success = bool(opened[f"{name}/success"][()].any())
                yield Episode(f"{file.stem}/{name}", frames, fps=20, success=success)


def pixels(file: Path, place: str) -> UInt8Array:
    """Read a camera's frames."""
    with h5py.File(file) as opened:
        return opened[place][()]
