# SPDX-License-Identifier: MIT
"""Programs of Debian that tests run, each a fixture. A test that asks for one is marked ``debian`` by that.

``make test`` runs none of these tests, and its last lines count them. ``make test-more`` runs them, and fails where a
program is missing.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

PACKAGES = {  # by program
    "chromedriver": "chromium-driver",
    "chromium": "chromium",
    "curl": "curl",
    "docker-compose": "docker-compose",
    "ffmpeg": "ffmpeg",
    "nginx": "nginx",
    "node": "nodejs",
    "openssl": "openssl",
    "prometheus": "prometheus",
    "promtool": "prometheus",
}
BROWSER = ("chromium", "chromedriver")
WAITING = pytest.StashKey[Counter[str]]()  # tests of this run that were left out, by packages
PATH = os.pathsep.join(
    [str(Path(sys.executable).parent), os.environ["PATH"], "/usr/sbin", "/usr/libexec/docker/cli-plugins"]
)


def find(name: str) -> str | None:
    """Return the path of a program; None: it is not installed."""
    return shutil.which(name, path=PATH)


def _program(name: str) -> Any:
    @pytest.fixture(scope="session", name=_fixture(name))
    def path() -> str:
        found = find(name)
        if found is None:
            pytest.fail(f"{name}: expected in PATH, got nothing (make ops-tools)")
        return found

    return path


def _fixture(program: str) -> str:
    return program.replace("-", "_")


curl, docker_compose, ffmpeg, nginx, node, openssl, prometheus, promtool = (
    _program(name) for name in sorted(PACKAGES.keys() - set(BROWSER))
)
PROGRAMS = {"browser": BROWSER, **{_fixture(name): (name,) for name in PACKAGES if name not in BROWSER}}  # by fixture


def _packages(item: pytest.Item) -> str:
    """Return the packages that a test needs."""
    asked = [PROGRAMS[name] for name in getattr(item, "fixturenames", ()) if name in PROGRAMS]
    return " ".join(sorted({PACKAGES[name] for names in asked for name in names}))


@pytest.hookimpl(tryfirst=True)  # before marks are selected
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if _packages(item):
            item.add_marker("debian")


def pytest_deselected(items: list[pytest.Item]) -> None:
    for item in items:
        if (packages := _packages(item)) and not item.get_closest_marker("nightly"):
            item.config.stash.setdefault(WAITING, Counter())[packages] += 1


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Every process of pytest-xdist collects all tests: the counts of one are those of all."""
    node.config.stash[WAITING] = Counter(getattr(node, "workeroutput", {}).get("waiting", {}))


def pytest_sessionfinish(session: pytest.Session) -> None:
    if (output := getattr(session.config, "workeroutput", None)) is not None:
        output["waiting"] = dict(session.config.stash.get(WAITING, Counter()))


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    for packages, count in sorted(config.stash.get(WAITING, Counter()).items()):
        terminalreporter.write_line(f"not run: {count} tests that need {packages} (make test-more)")


if __name__ == "__main__":  # for make ops-tools
    print(*sorted({package for name, package in PACKAGES.items() if find(name) is None}))
