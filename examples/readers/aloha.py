# SPDX-License-Identifier: MIT
"""ALOHA, and the input of openpi's converter: an HDF5 file for each episode. Needs h5py and Pillow.

rfm-client label aloha_folder --task "fold the towel" --reader examples/readers/aloha.py:episodes
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


def episodes(folder: Path) -> Iterator[Episode]:
    """Yield each file. If the recorder gave OpenCV RGB frames, red and blue are swapped: add --channels bgr."""
    for file in sorted(folder.glob("*.hdf5"), key=lambda file: (len(file.name), file.name)):
        with h5py.File(file) as opened:
            cameras, task = list(opened["observations/images"]), opened.attrs.get("task")
        yield Episode(file.stem, {each: partial(pictures, file, each) for each in cameras}, task=task, fps=50)


def pictures(file: Path, camera: str) -> Iterator[UInt8Array]:
    """Yield a camera's frames: pixels, or JPEG files that zeros make equally long."""
    with h5py.File(file) as opened:
        for stored in opened[f"observations/images/{camera}"]:
            yield stored if stored.ndim == 3 else np.asarray(Image.open(io.BytesIO(stored)).convert("RGB"))
