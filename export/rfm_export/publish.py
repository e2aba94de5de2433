# SPDX-License-Identifier: MIT
"""Move staged models into the repository so that Triton can load it at any moment.

New version folders are written aside, then renamed, so they appear whole. Triton does not serve them until the
configurations name them. Configurations are replaced in an order that keeps every intermediate state consistent.

The scratch folder lies in the repository: no other folder need be writable, or on the same file system. Triton takes
every folder in a repository for a model, unless its arguments name the models. Inside a model's folder, Triton ignores
folders whose name is not a number. So the scratch folder lies inside a model's folder; without
models, in the repository itself.

A model has one configuration for all versions, which names the newest version's checkpoint. So each version folder
keeps its export's configuration, for a later ``rollout``.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tritonclient.grpc import model_config_pb2 as pb

from rfm.serve.repository import CONFIG_FILE
from rfm_export.errors import ExportError
from rfm_export.layout import WARMUP_FOLDER, GeneratedModel, generated_files
from rfm_export.pbtxt import parse, render, serving_versions

_SCRATCH = ".export-"
_STEP_NS = 10**6  # file systems round times

_log = logging.getLogger(__name__)


@contextmanager
def alone(repository: Path, wait: Callable[[], object] | None = None) -> Iterator[None]:
    """Lock the repository against other exports and rollouts, if its file system supports locks.

    Removes scratch folders that killed processes left. While another export or rollout runs, calls ``wait`` and waits
    for its end; without ``wait`` raises ExportError.
    """
    _make_writable(repository)
    descriptor = os.open(repository, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # released when the process ends, even if killed
        except BlockingIOError:
            if wait is None:
                raise
            wait()
            fcntl.flock(descriptor, fcntl.LOCK_EX)
    except BlockingIOError:
        os.close(descriptor)
        raise ExportError.at(repository, "no other export or rollout at work", "one") from None
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL):
            os.close(descriptor)
            raise
        _log.warning("%s: expected a file system with locks, got: %s: nothing keeps others out", repository, error)
    else:
        for place in (repository, *_models(repository)):
            for left in list(place.glob(f"{_SCRATCH}*")):
                shutil.rmtree(left, ignore_errors=True)
    try:
        yield
    finally:
        os.close(descriptor)


def _make_writable(repository: Path) -> None:
    """Make the folder if it is missing. Raises ExportError for a folder that an export or rollout cannot change."""
    try:
        if (repository / CONFIG_FILE).exists():
            raise ExportError.at(repository, "a repository", f"a model of one: --repository {repository.parent}")
        repository.mkdir(parents=True, exist_ok=True)
        if not os.access(repository, os.W_OK | os.X_OK, effective_ids=True):
            reason = errno.EROFS if os.statvfs(repository).f_flag & os.ST_RDONLY else errno.EACCES
            raise OSError(reason, os.strerror(reason))
    except OSError as error:
        expected = "a folder that this user may change"
        raise ExportError.at(repository, expected, error.strerror, "--repository names another one") from error


@contextmanager
def staging(repository: Path, names: Sequence[str]) -> Iterator[Path]:
    """Yield a scratch folder in the repository, and remove it after the block.

    names: models that change; the folder lies in the first one that exists, because a new folder makes Triton
        reload a model at a load request
    """
    changing = [repository / name for name in names if (repository / name / CONFIG_FILE).is_file()]
    folder = Path(tempfile.mkdtemp(prefix=_SCRATCH, dir=next(iter([*changing, *_models(repository)]), repository)))
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


def _models(repository: Path) -> list[Path]:
    return sorted(file.parent for file in repository.glob(f"[!.]*/{CONFIG_FILE}"))


def next_version(repository: Path, names: Sequence[str]) -> int:
    """Return the models' highest version, plus 1."""
    folders = (path for name in names for path in (repository / name).glob("*"))
    return 1 + max((int(path.name) for path in folders if path.name.isdecimal()), default=0)


def read_config(repository: Path, name: str) -> pb.ModelConfig:
    """Return a model's configuration in the repository. Raises OSError, google.protobuf.text_format.ParseError."""
    return parse((repository / name / CONFIG_FILE).read_text())


def config_of(repository: Path, name: str, version: int) -> pb.ModelConfig:
    """Return the configuration that serves only this version. Raises OSError, ParseError."""
    kept = repository / name / str(version) / CONFIG_FILE
    current = read_config(repository, name)
    if version in current.version_policy.specific.versions and not kept.exists():  # its export kept none
        return serving_versions(current, [version])
    return serving_versions(parse(kept.read_text()), [version])


def replace_config(repository: Path, config: pb.ModelConfig, scratch: Path) -> None:
    """Replace a configuration atomically: readers never see a part.

    scratch: a folder on the same file system

    It becomes the model's newest file, also after the clock was set back: else Triton ignores the next load request.
    """
    new, model = scratch / CONFIG_FILE, repository / config.name
    new.write_text(render(config))
    newest_ns = max(path.lstat().st_mtime_ns for path in (new, model, *model.rglob("*")))
    os.utime(new, ns=(newest_ns, newest_ns + _STEP_NS))
    _replace(model / CONFIG_FILE, new)


def _replace(old: Path, new: Path) -> None:
    """Put a file in another's place, with its mode: the server may be another user."""
    if old.exists():
        shutil.copymode(old, new)
    new.replace(old)


def publish(repository: Path, staged: Path, models: Sequence[GeneratedModel]) -> None:
    """Write the generated files beside the staged weights, and move the models into the repository.

    A new model appears whole. An existing model first serves its old and its new version, then the ensembles change to
    the new version, then the old version goes.
    """
    for path, content in generated_files(models, staged).items():
        (staged / path).parent.mkdir(parents=True, exist_ok=True)
        (staged / path).write_bytes(content)
    replaced = [model for model in models if (repository / model.name).exists()]
    for model in models:
        (staged / model.name / str(model.version) / CONFIG_FILE).write_text(render(model.config))
    _settle(staged)
    for model in replaced:
        _keep_config(repository, model.name, staged)
    for model in models:
        if model not in replaced:
            (staged / model.name).rename(repository / model.name)
            continue
        (staged / model.name / str(model.version)).rename(repository / model.name / str(model.version))
        for file in model.warmup_files:
            target = repository / model.name / WARMUP_FOLDER
            target.mkdir(exist_ok=True)
            _replace(target / file, staged / model.name / WARMUP_FOLDER / file)

    parts = [model for model in replaced if not model.is_ensemble]
    for model in parts:
        served = read_config(repository, model.name).version_policy.specific.versions
        replace_config(repository, serving_versions(model.config, sorted({*served, model.version})), staged)
    for model in (*(model for model in replaced if model.is_ensemble), *parts):
        replace_config(repository, model.config, staged)


def _settle(staged: Path) -> None:
    """Flush all files to disk, so that a power cut leaves no partial file. Raises ExportError for a link."""
    for path in (staged, *staged.rglob("*")):
        if path.is_symlink():
            raise ExportError.at(path, "a file or folder", "a link")
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _keep_config(repository: Path, name: str, scratch: Path) -> None:
    """Keep the served version's configuration in its folder, if its export kept none."""
    current = read_config(repository, name)
    kept = repository / name / str(max(current.version_policy.specific.versions)) / CONFIG_FILE
    if not kept.exists():
        (scratch / CONFIG_FILE).write_text(render(current))
        (scratch / CONFIG_FILE).replace(kept)
