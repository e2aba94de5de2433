# SPDX-License-Identifier: MIT
"""A video and a repository for the tests of the client."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import clip
from engine_server import engines  # noqa: F401  a fixture
from paths import ROOT


@pytest.fixture(scope="session")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("videos") / "clip.mp4"
    clip.write(file)
    return file


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("TERMINAL_WIDTH", "200")
    monkeypatch.delenv("RFM_URL", raising=False)


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """The demo's checkpoint with a single instance."""
    folder = tmp_path / "model_repository"
    shutil.copytree(ROOT / "model_repository" / "rfm", folder / "rfm")
    return folder
