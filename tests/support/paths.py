# SPDX-License-Identifier: MIT
"""Folders of the repository."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "golden"
VIDEOS = ROOT / "tests" / "videos"
