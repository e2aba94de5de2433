# SPDX-License-Identifier: MIT
"""Certificates, and a repository with one small model."""

from __future__ import annotations

from pathlib import Path

import pytest

import goldens
import rfm_export
from engines import serve_config
from secured import Papers


@pytest.fixture(scope="module")
def papers(tmp_path_factory: pytest.TempPathFactory) -> Papers:
    return Papers.issue(tmp_path_factory.mktemp("papers"))


@pytest.fixture(scope="module")
def repository(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The repository of a reference checkpoint for embeddings."""
    config, folder = goldens.config("c1_t1_disc10"), tmp_path_factory.mktemp("exposed") / "model_repository"
    rfm_export.export(config.checkpoint, folder, serve_config(config))
    return folder
