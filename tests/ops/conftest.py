# SPDX-License-Identifier: MIT
"""Programs of Debian that tests of docker/ run."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

PLACES = (Path(sys.executable).parent, os.environ["PATH"], "/usr/sbin", "/usr/libexec/docker/cli-plugins")


def program(name: str) -> Any:
    @pytest.fixture(scope="session")
    def found() -> str:
        path = shutil.which(name, path=":".join(map(str, PLACES)))
        assert path, f"{name}: expected in PATH, got nothing (make ops-tools)"
        return path

    return found


promtool, prometheus, nginx = program("promtool"), program("prometheus"), program("nginx")
docker_compose = program("docker-compose")  # also Docker's plugin, which is a program by itself
