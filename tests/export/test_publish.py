# SPDX-License-Identifier: MIT
"""What an export or a rollout needs of the file system, and what Triton sees of a repository meanwhile."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

import goldens
import rfm_export
from engines import serve_config
from one_model import BriefServer
from rfm.launch.installation import find_installation
from rfm.launch.process import Endpoints, TritonServer
from rfm.launch.repository_api import RepositoryApi
from rfm_client import RewardClient
from rfm_commands.rollout import Rollout, previous_version
from rfm_export.publish import staging
from rfm_serve import model_processes
from trajectories import random_trajectory

pytestmark = pytest.mark.triton

PLAIN = goldens.config("c1_t1_disc10")
KEY = "a-key-that-only-tests-know"
NOBODY = 65534
HANG_S = PATIENCE_S = 60.0
POLL_S = 0.05


def export(repository: Path, name: str = "rfm", checkpoint: Path = PLAIN.checkpoint) -> int:
    return rfm_export.export(checkpoint, repository, serve_config(PLAIN, name))


@contextmanager
def served(repository: Path, log: Path, kind: type[TritonServer] = BriefServer) -> Iterator[TritonServer]:
    with (
        log.open("wb") as lines,
        kind(repository, Endpoints.free(), find_installation(), log=lines, admin_key=KEY) as server,
    ):
        yield server


@dataclass(frozen=True)
class Mounted:
    """A repository, all that its user may write."""

    repository: Path
    checkpoint: Path

    @contextmanager
    def as_user(self) -> Iterator[None]:
        """Root may write everywhere, and is nobody meanwhile."""
        user = os.geteuid()
        if user == 0:
            os.seteuid(NOBODY)
        try:
            assert not os.access(self.repository.parent, os.W_OK, effective_ids=True)
            yield
        finally:
            os.seteuid(user)


@pytest.fixture
def mounted() -> Iterator[Mounted]:
    folder = Path(tempfile.mkdtemp(prefix="rfm-mounted-"))  # pytest's own is closed to nobody
    repository, checkpoint = folder / "repository", folder / "checkpoint"
    shutil.copytree(PLAIN.checkpoint, checkpoint)
    repository.mkdir()
    if os.geteuid() == 0:
        os.chown(repository, NOBODY, NOBODY)
    folder.chmod(0o555)
    try:
        yield Mounted(repository, checkpoint)
    finally:
        folder.chmod(0o755)
        shutil.rmtree(folder)


@pytest.mark.slow
def test_only_the_repository_must_be_writable(mounted: Mounted, tmp_path: Path) -> None:
    repository, checkpoint = mounted.repository, mounted.checkpoint
    export(tmp_path / "other")  # imports what nobody need be allowed to read
    with mounted.as_user():
        assert export(repository, checkpoint=checkpoint) == 1
    with (
        served(repository, tmp_path / "log") as server,
        RepositoryApi(server.endpoints.grpc_url, KEY) as api,
        mounted.as_user(),
    ):
        assert export(repository, checkpoint=checkpoint) == 2
        rollout = Rollout(repository, "rfm", api, lambda line: None)
        rollout.to(2)
        assert api.ready_versions("rfm") == [2]
        rollout.to(previous_version(repository, "rfm", api))
        assert api.ready_versions("rfm") == [1]
    assert sorted(path.name for path in repository.iterdir()) == ["rfm"]
    assert sorted(path.name for path in (repository / "rfm").iterdir()) == ["1", "2", "config.pbtxt", "warmup"]


class LoadsAll(BriefServer):
    """As an operator may run Triton without ``rfm serve``: each folder of the repository is a model."""

    mode = "none"

    def _arguments(self, models: Sequence[str]) -> list[str]:
        told = [argument for argument in super()._arguments(models) if not argument.startswith("--load-model")]
        return [argument.replace("explicit", self.mode) for argument in told]


class Polls(LoadsAll):
    mode = "poll"

    def _arguments(self, models: Sequence[str]) -> list[str]:
        return [*super()._arguments(models), "--repository-poll-secs=1"]  # it ends only when it has slept for so long


@pytest.mark.parametrize("kind", [LoadsAll, Polls, BriefServer])
def test_triton_does_not_see_what_is_staged(kind: type[TritonServer], tmp_path: Path) -> None:
    """Nor what an export left that was killed."""
    repository = tmp_path / "repository"
    export(repository)
    with staging(repository, ["rfm"]) as scratch:
        shutil.copytree(repository / "rfm", scratch / "rfm", ignore=shutil.ignore_patterns(scratch.name))
        shutil.copy(repository / "rfm" / "config.pbtxt", scratch)
        with (
            served(repository, tmp_path / "log", kind) as server,
            RepositoryApi(server.endpoints.grpc_url, KEY) as api,
            RewardClient(server.endpoints.grpc_url) as client,
        ):
            assert [(entry.name, entry.version, entry.state) for entry in api.index()] == [("rfm", 1, "READY")]
            client.progress(random_trajectory(0, 3))


def living(triton: int) -> list[int]:
    """Processes of ``rfm``, as soon as those of one load alone are alive."""
    deadline_s = time.monotonic() + PATIENCE_S
    while len(found := model_processes(triton)) > 1:
        assert time.monotonic() < deadline_s, found
        time.sleep(POLL_S)
    return found


def test_an_export_changes_no_model_of_another_name(tmp_path: Path) -> None:
    """One that is loaded again has the processes that it had, since its files are what they were."""
    repository = tmp_path / "repository"
    export(repository)
    with served(repository, tmp_path / "log") as server, RepositoryApi(server.endpoints.grpc_url, KEY) as api:
        api.load("rfm")  # the first load after the start is a new one anyway
        before = living(server.pid)
        export(repository, "another")
        api.load("rfm")
        assert living(server.pid) == before != []


@pytest.mark.parametrize(
    "place",
    [
        pytest.param(lambda repository: repository, id="of the first export"),
        pytest.param(lambda repository: repository / "rfm", id="of a later one"),
        pytest.param(lambda repository: repository / "another", id="of another name"),
    ],
)
def test_the_next_export_removes_what_a_killed_one_left(place: Callable[[Path], Path], tmp_path: Path) -> None:
    repository = tmp_path / "repository"
    for name in ("another", "rfm"):
        export(repository, name)
    left = place(repository) / ".export-killed"
    (left / "rfm").mkdir(parents=True)
    export(repository)
    assert not left.exists()
