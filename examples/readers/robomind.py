# SPDX-License-Identifier: MIT
"""RoboMIND: an HDF5 file for each episode, with a JPEG file for each frame. Needs h5py and Pillow.

rfm-client label h5_franka_3rgb/open_the_drawer --reader examples/readers/robomind.py:episodes
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import h5py
import numpy as np
from PIL import Image

from rfm_client import UInt8Array
from rfm_labels import Episode

SIZES = {height * width * 3: (height, width, 3) for height, width in ((480, 640), (720, 1280))}


def episodes(folder: Path) -> Iterator[Episode]:
    """Yield each ``trajectory.hdf5``. AgileX and Tien Kung robots store red as blue: add --channels bgr."""
    for file in sorted(folder.rglob("trajectory.hdf5")):
        with h5py.File(file) as opened:
            cameras, task = list(opened["observations/rgb_images"]), opened["language_raw"][0].decode()
        name = str(file.parent.relative_to(folder))
        yield Episode(name, {each: partial(pictures, file, each) for each in cameras}, task=task, fps=30)


def pictures(file: Path, camera: str) -> Iterator[UInt8Array]:
    """Decode a camera's frames, some of which are pixels, blue first."""
    with h5py.File(file) as opened:
        for stored in opened[f"observations/rgb_images/{camera}"]:
            raw = np.asarray(stored, np.uint8)
            shape = None if raw[:2].tobytes() == b"\xff\xd8" else SIZES[raw.size]
            yield raw.reshape(shape)[..., ::-1] if shape else np.asarray(Image.open(io.BytesIO(raw)).convert("RGB"))
