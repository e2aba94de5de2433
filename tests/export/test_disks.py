# SPDX-License-Identifier: MIT
"""Checkpoints that cannot be read, and repositories that cannot be written."""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

import goldens
import rfm_export
from commands import REPOSITORY
from engines import serve_config
from rfm import families
from rfm.checkpoint.content import CheckpointError
from rfm.launch.installation import ServerStartError, find_installation
from rfm.launch.process import Endpoints, TritonServer
from rfm_export import ExportError
from rfm_export.publish import alone
from spoilt import WEIGHTS, copied, files_in, weights

REWIND = goldens.config("legacy_keys_l2")
LONGEST_S = 60


@contextmanager
def as_any_user(folder: Path) -> Iterator[None]:
    """A context in which this process, in ``folder``, has the rights of a user who may not do everything."""
    user = os.geteuid()
    try:
        if user == 0:
            folder.chmod(0o755)
            os.seteuid(65534)
        yield
    finally:
        os.seteuid(user)


def test_a_file_that_may_not_be_read_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder = copied(REWIND, Path("checkpoint"))
    (folder / "config.json").chmod(0)
    with as_any_user(tmp_path), pytest.raises(CheckpointError, match=r"Permission ?[dD]enied|PermissionError"):
        families.load(folder)


ROOMS = {"0": 0, "100": 100, "half": (REWIND.checkpoint / WEIGHTS).stat().st_size // 2}
# One `rfm export` after the other, each under a limit of file sizes, in a process of their own.
IN_LITTLE_ROOM = """
import io, json, resource, sys
from contextlib import redirect_stderr
from rfm_commands.cli import main
checkpoint, *exports = sys.argv[1:]
for room, repository in map(json.loads, exports):
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
    sys.argv = ["rfm", "export", "--checkpoint", checkpoint, "--repository", repository]
    status, errors = 0, io.StringIO()
    try:
        with redirect_stderr(errors):
            main()
    except SystemExit as ended:
        status = ended.code
    print(json.dumps([status, errors.getvalue()]))
"""


@dataclass(frozen=True)
class FullDisk:
    """What an export onto one said, and the files there before."""

    folder: Path
    before: dict[str, bytes]
    status: int
    errors: str


@pytest.fixture(scope="module")
def full_disks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, FullDisk]:
    folders = {name: tmp_path_factory.mktemp(f"room_{name}") for name in ROOMS}
    before = {}
    for name, folder in folders.items():
        rfm_export.export(REWIND.checkpoint, folder / "model_repository", serve_config(REWIND))
        before[name] = files_in(folder)
    exports = [json.dumps([room, str(folders[name] / "model_repository")]) for name, room in ROOMS.items()]
    ended = subprocess.run(
        [sys.executable, "-c", IN_LITTLE_ROOM, str(REWIND.checkpoint), *exports],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
        timeout=LONGEST_S,
    )
    said = map(json.loads, ended.stdout.splitlines())
    return {name: FullDisk(folders[name], before[name], *told) for name, told in zip(ROOMS, said, strict=True)}


@pytest.mark.parametrize("room", ROOMS)
def test_a_full_disk_is_told_and_changes_nothing(full_disks: dict[str, FullDisk], room: str) -> None:
    disk = full_disks[room]
    assert disk.status == 1
    assert files_in(disk.folder) == disk.before
    assert not list(disk.folder.rglob(".*"))
    told = (
        r"rfm: .*/model_repository: expected room for the exported files, got: .*[Ff]ile too large.*; the versions that "
        r"are served stay as they are; make room there, or name another --repository\n"
    )
    *notes, error = disk.errors.splitlines(keepends=True)
    assert re.fullmatch(told, error), disk.errors
    assert notes.pop(0) == f"rfm: {REWIND.checkpoint}/config.yaml: read as the settings of the training run\n"
    assert notes.pop().startswith("rfm: assumed, and not shown by the checkpoint: causal_mask false (")
    assert all(note.startswith("rfm: config.yaml: model.train_") for note in notes)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda folder: folder.mkdir(0o555),
            "that this user may change, got: Permission denied; --repository names an",
        ),
        (
            lambda folder: folder.write_text(""),
            "that this user may change, got: File exists; --repository names another",
        ),
        (lambda folder: shutil.copytree(REPOSITORY / "rfm", folder), "got a model of one: --repository ."),
    ],
    ids=["read-only", "a file", "a model"],
)
def test_an_export_into_what_takes_none_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[[Path], object], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = Path("models")
    make(folder)
    with as_any_user(tmp_path), pytest.raises(ExportError, match=re.escape(message)), alone(folder):
        raise AssertionError("it may be changed")


def test_two_exports_at_a_time_are_one_too_many(tmp_path: Path) -> None:
    repository = tmp_path / "model_repository"
    left = repository / ".export-killed"
    left.mkdir(parents=True)
    descriptor = os.open(repository, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    try:
        with pytest.raises(ExportError, match="model_repository: expected no other export or rollout at work, got one"):
            rfm_export.export(REWIND.checkpoint, repository, serve_config(REWIND))
        assert left.exists()  # it may be the other's
    finally:
        os.close(descriptor)
    assert rfm_export.export(REWIND.checkpoint, repository, serve_config(REWIND)) == 1
    assert not left.exists()


@pytest.mark.triton
def test_weights_that_have_changed_since_their_export_are_not_served(tmp_path: Path) -> None:
    repository = tmp_path / "model_repository"
    rfm_export.export(REWIND.checkpoint, repository, serve_config(REWIND))
    file = repository / "rfm" / "1" / "checkpoint" / WEIGHTS
    content = bytearray(file.read_bytes())
    content[-2] ^= 1  # of one number, a little
    file.write_bytes(content)
    log_file = tmp_path / "triton.log"
    with log_file.open("wb") as log:
        server = TritonServer(repository, Endpoints.free(), find_installation(), log=log)
        with pytest.raises(ServerStartError), server:
            pass
    assert re.search(r"rfm/1: expected the weights that were exported \(\w{16}\), got others", log_file.read_text())


def test_version_folders_keep_their_digests_side_by_side(tmp_path: Path) -> None:
    """A configuration for all versions tells the newest one's; the older are checked against their own."""
    from rfm.triton_model.weights import check_digest
    from rfm_export.publish import read_config

    repository = tmp_path / "model_repository"
    other = copied(REWIND, tmp_path / "other")
    weights(lambda tensors: tensors["video_proj.bias"].add_(1))(other)
    for source in (REWIND.checkpoint, other):
        rfm_export.export(source, repository, serve_config(REWIND))
    told = read_config(repository, "rfm").parameters["weights_digest"].string_value
    for version in ("1", "2"):
        check_digest(repository / "rfm" / version, told)
    shutil.copy(other / WEIGHTS, repository / "rfm" / "1" / "checkpoint" / WEIGHTS)
    with pytest.raises(CheckpointError, match="rfm/1: expected the weights that were exported"):
        check_digest(repository / "rfm" / "1", told)
