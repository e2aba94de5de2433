# SPDX-License-Identifier: MIT
"""Certificates."""

from __future__ import annotations

import pytest

from secured import Papers


@pytest.fixture(scope="module")
def papers(tmp_path_factory: pytest.TempPathFactory) -> Papers:
    return Papers.issue(tmp_path_factory.mktemp("papers"))
