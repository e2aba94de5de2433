# SPDX-License-Identifier: MIT
"""File permissions for an export, the repository as Triton sees it meanwhile, and the files that Triton loads."""

from __future__ import annotations

import fcntl
import os
import re
import resource
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import goldens
import rfm_export
from commands import REPOSITORY
from engines import serve_config
from in_process import rfm
from rfm import published
from rfm.files import CheckpointError
from rfm.serve.repository_api import RepositoryApi, RepositoryApiError
from rfm_export import ExportError
from rfm_export.publish import alone, read_config, staging
from servers import Served
from spoilt import WEIGHTS, copied, files_in, weights

PLAIN, SMALL = goldens.config("c1_t1_disc10"), goldens.config("legacy_keys_l2")
FRAMES = goldens.config("enc_c1_t1_disc10")
NOBODY = 65534


def export(repository: Path, name: str = "rfm", config: goldens.Config = SMALL, checkpoint: Path | None = None) -> int:
    return rfm_export.export(checkpoint or config.checkpoint, repository, serve_config(config, name))


@contextmanager
def as_any_user(folder: Path) -> Iterator[None]:
    """A context in which this process, in ``folder``, has an ordinary user's rights."""
    user = os.geteuid()
    try:
        if user == 0:
            folder.chmod(0o755)
            os.seteuid(NOBODY)
        yield
    finally:
        os.seteuid(user)


def test_a_file_without_read_permission_is_refused_with_that_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = copied(SMALL, Path("checkpoint"))
    (folder / "config.json").chmod(0)
    with as_any_user(tmp_path), pytest.raises(CheckpointError, match=r"Permission ?[dD]enied|PermissionError"):
        published.load(folder)


def test_only_the_repository_must_be_writable(tmp_path: Path) -> None:
    folder = Path(tempfile.mkdtemp(prefix="rfm-mounted-"))  # pytest's folder is open to everybody
    repository, checkpoint = folder / "repository", shutil.copytree(SMALL.checkpoint, folder / "checkpoint")
    repository.mkdir()
    if os.geteuid() == 0:
        os.chown(repository, NOBODY, NOBODY)
    export(tmp_path / "other")  # imports modules that other users may not read
    try:
        with as_any_user(folder):
            assert not os.access(folder, os.W_OK, effective_ids=True)
            assert [export(repository, checkpoint=checkpoint) for _ in range(2)] == [1, 2]
    finally:
        folder.chmod(0o755)
    assert sorted(path.name for path in repository.iterdir()) == ["rfm"]
    assert sorted(path.name for path in (repository / "rfm").iterdir()) == ["1", "2", "config.pbtxt", "warmup"]
    shutil.rmtree(folder)


@pytest.mark.parametrize("room", [0, 100, (SMALL.checkpoint / WEIGHTS).stat().st_size // 2])
def test_an_export_to_a_full_disk_fails_with_a_message_and_changes_nothing(tmp_path: Path, room: int) -> None:
    """Be it full at once, behind a small file, or in the middle of the weights."""
    repository = tmp_path / "model_repository"
    export(repository)
    before = files_in(tmp_path)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
    try:
        words = ["export", "--checkpoint", str(SMALL.checkpoint), "--repository", str(repository)]
        result = rfm(*words)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert files_in(tmp_path) == before
    assert not list(tmp_path.rglob(".*"))
    expected = (
        r"rfm: .*/model_repository: expected room for the exported files, got .*[Ff]ile too large.*; the versions that "
        r"are served stay as they are; make room there, or name another --repository"
    )
    assert result.exit_code == 1
    assert re.fullmatch(expected, result.stderr.splitlines()[-1]), result.stderr


NO_REPOSITORY: dict[str, tuple[Callable[[Path], object], str]] = {
    "read-only": (lambda folder: folder.mkdir(0o555), "may change, got Permission denied; --repository names another"),
    "a file": (lambda folder: folder.write_text(""), "may change, got File exists; --repository names another"),
    "a model": (lambda folder: shutil.copytree(REPOSITORY / "rfm", folder), "got a model of one: --repository ."),
}


@pytest.mark.parametrize(("make", "message"), NO_REPOSITORY.values(), ids=NO_REPOSITORY)
def test_an_export_into_an_unusable_folder_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[[Path], object], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = Path("models")
    make(folder)
    with as_any_user(tmp_path), pytest.raises(ExportError, match=re.escape(message)), alone(folder):
        raise AssertionError("it may be changed")


def changed_at(folder: Path) -> dict[Path, int]:
    return {file: file.stat().st_mtime_ns for file in folder.rglob("*") if file.is_file()}


def test_files_that_an_export_replaces_keep_their_modes_because_the_server_may_be_another_user(tmp_path: Path) -> None:
    export(tmp_path)
    files = [tmp_path / "rfm" / "config.pbtxt", *(tmp_path / "rfm" / "warmup").iterdir()]
    for file in files:
        file.chmod(0o644)
    umask = os.umask(0o077)
    try:
        assert export(tmp_path) == 2
    finally:
        os.umask(umask)
    assert {f"{file.stat().st_mode & 0o777:o}" for file in files} == {"644"}


def test_a_second_export_at_a_time_is_refused_and_the_next_removes_remains_of_a_killed_one(tmp_path: Path) -> None:
    """It touches no file of another model, which would make Triton load that again, too."""
    repository = tmp_path / "model_repository"
    for name in ("another", "rfm"):
        export(repository, name)
    before = changed_at(repository / "another")
    left = [repository / place / ".export-killed" for place in (".", "rfm", "another")]
    for folder in left:
        (folder / "rfm").mkdir(parents=True)
    descriptor = os.open(repository, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    try:
        with pytest.raises(ExportError, match="model_repository: expected no other export or rollout at work, got one"):
            export(repository)
        assert all(folder.exists() for folder in left)  # they may be the other's
    finally:
        os.close(descriptor)
    assert export(repository) == 2
    assert not any(folder.exists() for folder in left)
    assert changed_at(repository / "another") == before


def check_loadable(repository: Path) -> None:
    """Whatever Triton would load now is whole and fits together."""
    configs = {path.parent.name: read_config(repository, path.parent.name) for path in repository.glob("[!.]*/*.pbtxt")}
    assert configs.keys() == {path.name for path in repository.glob("[!.]*")}
    served = {name: list(config.version_policy.specific.versions) for name, config in configs.items()}
    for name, config in configs.items():
        assert served[name]
        assert all(any((repository / name / str(version)).iterdir()) for version in served[name])
        for warmup in config.model_warmup:
            for tensor in warmup.inputs.values():
                assert tensor.zero_data or (repository / name / "warmup" / tensor.input_data_file).is_file()
        for step in config.ensemble_scheduling.step:
            assert step.model_version in served[step.model_name]


@pytest.mark.parametrize(("num_before", "fewest"), [(0, 3), (1, 8)], ids=["first export", "second export"])
def test_an_export_that_dies_at_any_moment_leaves_a_repository_that_loads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, num_before: int, fewest: int
) -> None:
    """Check the repository between any two file operations, where a kill could strike.

    At first those move three folders; later three versions, warm-up files and five configurations.
    """
    repository = tmp_path / "model_repository"
    for _ in range(num_before):
        export(repository, config=FRAMES)
    count = 0

    def checked(original: Any) -> Any:
        def move(self: Path, target: Path) -> Path:
            nonlocal count
            if repository in Path(target).parents:
                check_loadable(repository)
                count += 1
            return Path(original(self, target))

        return move

    monkeypatch.setattr(Path, "rename", checked(Path.rename))
    monkeypatch.setattr(Path, "replace", checked(Path.replace))
    export(repository, config=FRAMES)
    check_loadable(repository)
    assert count >= fewest


@pytest.mark.triton
def test_triton_does_not_see_staged_models(served: Served) -> None:
    """Nor the remains of a killed export."""
    with RepositoryApi(served.url("grpc"), served.server.admin_key) as api:
        before = {entry.name for entry in api.index()}
        with staging(served.repository, ["rfm"]) as scratch:
            shutil.copytree(served.repository / "rfm", scratch / "rfm", ignore=shutil.ignore_patterns(scratch.name))
            shutil.copy(served.repository / "rfm" / "config.pbtxt", scratch)
            assert {entry.name for entry in api.index()} == before
            shutil.copytree(served.repository / "rfm", served.repository / "seen")
            assert {entry.name for entry in api.index()} == {*before, "seen"}  # or this test would see nothing
            shutil.rmtree(served.repository / "seen")


@pytest.mark.triton
@pytest.mark.slow
def test_weights_that_have_changed_since_their_export_are_not_served(served: Served) -> None:
    """Each version is compared with its own configuration; the shared one describes the newest."""
    export(served.repository, "changed")
    folder = served.repository / "changed" / "1" / "checkpoint"
    with RepositoryApi(served.url("grpc"), served.server.admin_key) as api:
        other = copied(SMALL, served.repository.parent / "other")
        weights(lambda tensors: tensors["video_proj.bias"].add_(1))(other)
        export(served.repository, "changed", checkpoint=other)
        config = served.repository / "changed" / "config.pbtxt"
        config.write_text(config.read_text().replace("versions: 2", "versions: 1 versions: 2"))
        api.load("changed")
        assert api.ready_versions("changed") == [1, 2]
        api.unload("changed")
        api.wait_gone("changed")
        content = bytearray((folder / WEIGHTS).read_bytes())
        content[-2] ^= 1  # of one number, a little
        (folder / WEIGHTS).write_bytes(content)
        with pytest.raises(RepositoryApiError):
            api.load("changed")
        api.unload("changed")
    log = (served.repository.parent / "tritonserver.log").read_text()
    assert re.search(r"changed/1: expected the weights that were exported \(\w{16}\), got others", log)
