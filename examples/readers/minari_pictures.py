# SPDX-License-Identifier: MIT
"""Minari: observations that are pictures. Needs h5py and Pillow.

rfm-client label ~/.minari/datasets/my/pictures-v0 --task "..." --reader examples/readers/minari_pictures.py:episodes
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

CAMERAS = ("pixels",)  # keys of observations


def episodes(folder: Path) -> Iterator[Episode]:
    """Yield the episodes in order. The last observation, after the last action, is a frame, too."""
    file = folder / "data" / "main_data.hdf5"
    with h5py.File(file) as opened:
        for number in range(len(opened)):
            name = f"episode_{number}"
            frames = {camera: partial(pictures, file, f"{name}/observations/{camera}") for camera in CAMERAS}
            successes = opened.get(f"{name}/infos/success")  # with record_infos=True
            yield Episode(name, frames, success=None if successes is None else bool(successes[()].any()))


def pictures(file: Path, place: str) -> Iterator[UInt8Array]:
    """Yield a camera's frames: JPEG files, or pixels (jpeg_encoding=False)."""
    with h5py.File(file) as opened:
        for stored in opened[place]:
            yield stored if stored.ndim == 3 else np.asarray(Image.open(io.BytesIO(stored)).convert("RGB"))
