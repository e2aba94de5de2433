# SPDX-License-Identifier: MIT
"""Unitree's xr_teleoperate: ``data.json`` names the task and, for each frame, a picture of each camera.

rfm-client label recordings --reader examples/readers/unitree.py:episodes
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from rfm_labels import Episode


def episodes(folder: Path) -> Iterator[Episode]:
    """Yield each folder with a ``data.json``."""
    for file in sorted(folder.glob("*/data.json")):
        recording = json.loads(file.read_text(encoding="utf-8"))
        steps = [step["colors"] for step in recording["data"]]
        frames = {camera: [file.parent / step[camera] for step in steps] for camera in sorted(set().union(*steps))}
        about = recording.get("info", {}).get("image", {})
        yield Episode(file.parent.name, frames, task=recording["text"]["goal"], fps=about.get("fps"))
