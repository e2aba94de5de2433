# SPDX-License-Identifier: MIT
"""DROID's raw recordings: MP4 files of three cameras, and JSON with the task and the outcome.

rfm-client label droid_raw/1.0.1 --reader examples/readers/droid_raw.py:episodes
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from rfm_labels import Episode

CAMERAS = ("wrist", "ext1", "ext2")


def episodes(folder: Path) -> Iterator[Episode]:
    """Yield each folder with ``metadata_*.json``, which only complete recordings have."""
    for file in sorted(folder.rglob("metadata_*.json")):
        about, videos = json.loads(file.read_text()), file.parent / "recordings" / "MP4"
        frames = {camera: videos / Path(about[f"{camera}_mp4_path"]).name for camera in CAMERAS}
        name = str(file.parent.relative_to(folder))
        yield Episode(name, frames, task=about["current_task"], success=about["success"])
