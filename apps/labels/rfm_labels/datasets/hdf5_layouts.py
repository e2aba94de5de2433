# SPDX-License-Identifier: MIT
"""Recognise HDF5 layouts without a reader, and say how to convert them. Needs h5py."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

_GUIDE = 'see "HDF5 files in other layouts" in docs/guides/label_a_dataset.md'
_ENCODED = "with JPEG files as pictures"
_ALOHA = (
    "ALOHA's layout, one episode per file (observations/images): convert its folder to LeRobot with openpi's "
    "examples/aloha_real/convert_aloha_data_to_lerobot.py"
)
_ROBOMIND = (
    f"RoboMIND's layout, one episode per file (observations/rgb_images) {_ENCODED}: convert its folder to LeRobot with "
    f"robomind2lerobot of https://github.com/Tavish9/any4lerobot, or {_GUIDE}"
)
_ROBOTWIN = (
    f"RoboTwin's layout, one episode per file (observation/CAMERA/rgb) {_ENCODED}: label the folder of videos beside "
    f"it (video/), which shows the head camera, or {_GUIDE}"
)
_MANISKILL = (
    "ManiSkill's layout (traj_0, traj_1 and so on): link its pictures (obs/sensor_data/CAMERA/rgb) into "
    f"data/demo_<i>/obs/CAMERA, {_GUIDE}. A file without pictures gets them from python -m "
    "mani_skill.trajectory.replay_trajectory -o rgb --save-traj"
)
_TRAJECTORY = re.compile(r"traj_\d+")


def foreign_layout(opened: Any) -> str | None:
    """Return the name of an open file's layout, with a remedy; None if it is unknown or has a reader."""
    for group, layout in (("observations/rgb_images", _ROBOMIND), ("observations/images", _ALOHA)):
        if group in opened:
            return layout
    cameras = opened.get("observation")
    if hasattr(cameras, "keys") and any(f"{camera}/rgb" in cameras for camera in cameras):
        return _ROBOTWIN
    return _MANISKILL if "data" not in opened and any(map(_TRAJECTORY.fullmatch, opened)) else None


def foreign_layout_of(file: Path) -> str | None:
    """Return ``foreign_layout`` of a file; None also without h5py or for an unreadable file."""
    try:
        import h5py

        with h5py.File(file, "r") as opened:
            return foreign_layout(opened)
    except (ImportError, OSError, RuntimeError):
        return None
