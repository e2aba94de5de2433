# SPDX-License-Identifier: MIT
"""Where tests find what the repository holds."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "golden"
VIDEOS = ROOT / "tests" / "videos"
