# SPDX-License-Identifier: MIT
"""RoboTwin 2.0: a JPEG file for each frame in HDF5, and sentences in JSON files. Needs h5py and Pillow.

rfm-client label beat_block_hammer/demo_clean --reader examples/readers/robotwin.py:episodes
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import h5py
import numpy as np
from PIL import Image

from rfm_client import UInt8Array
from rfm_labels import Episode


def episodes(folder: Path) -> Iterator[Episode]:
    """Yield each file in ``data``, with the first of its sentences for training."""
    for file in sorted((folder / "data").glob("*.hdf5"), key=lambda file: (len(file.name), file.name)):
        sentences = json.loads((folder / "instructions" / f"{file.stem}.json").read_text())["seen"]
        with h5py.File(file) as opened:
            cameras = [name for name, camera in opened["observation"].items() if "rgb" in camera]
        yield Episode(file.stem, {each: partial(pictures, file, each) for each in cameras}, task=sentences[0])


def pictures(file: Path, camera: str) -> Iterator[UInt8Array]:
    """Decode a camera's frames. Files from before September 2026, without the mark XPL-RGB1, store red as blue."""
    with h5py.File(file) as opened:
        for stored in opened[f"observation/{camera}/rgb"]:
            pixels = np.asarray(Image.open(io.BytesIO(stored)).convert("RGB"))
            yield pixels if b"XPL-RGB1" in stored[:4096] else pixels[..., ::-1]
