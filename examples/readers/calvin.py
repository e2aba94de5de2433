# SPDX-License-Identifier: MIT
"""CALVIN: a file for each step, and sentences for stretches of them.

rfm-client label task_D_D/training --reader examples/readers/calvin.py:episodes
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from rfm_client import UInt8Array
from rfm_labels import Episode

CAMERAS = ("rgb_static", "rgb_gripper")


def episodes(folder: Path) -> Iterator[Episode]:
    """Yield each stretch that has a sentence. ``auto_lang_ann.npy`` is a pickle: load it only if you trust it."""
    annotations = np.load(folder / "lang_annotations" / "auto_lang_ann.npy", allow_pickle=True).item()
    stretches = zip(annotations["info"]["indx"], annotations["language"]["ann"], strict=True)
    for number, ((start, end), sentence) in enumerate(stretches):
        frames = {camera: partial(steps, folder, camera, int(start), int(end)) for camera in CAMERAS}
        yield Episode(f"{number:05d}_{start}_{end}", frames, task=str(sentence), fps=30)


def steps(folder: Path, camera: str, start: int, end: int) -> Iterator[UInt8Array]:
    """Yield a camera's frames of the steps from ``start`` to ``end``, which is the last."""
    for step in range(start, end + 1):
        with np.load(folder / f"episode_{step:07d}.npz") as stored:
            yield stored[camera]
