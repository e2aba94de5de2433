# SPDX-License-Identifier: MIT
"""The environment with LeRobot and the plug-in, which ``make test-newest`` makes: LeRobot needs another Python."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from paths import ROOT

PYTHON = ROOT / ".venv" / "lerobot" / "bin" / "python"
IS_THERE = pytest.mark.skipif(not PYTHON.exists(), reason="make test-newest installs LeRobot")


def run(arguments: Sequence[str | Path], folder: Path) -> str:
    """Run LeRobot's Python in a folder, and return what it prints."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [PYTHON, *arguments],
        cwd=folder,
        env=environment | {"HF_HUB_OFFLINE": "1", "MUJOCO_GL": "egl"},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
