# SPDX-License-Identifier: MIT
"""Staged models -> the repository, so that at every moment the repository can be loaded.

New version folders appear whole (written aside, then renamed) and are not served until the configurations,
replaced one by one, name them. The order in which that happens keeps every intermediate state consistent.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tritonclient.grpc import model_config_pb2 as pb

from rfm_export.layout import CONFIG_FILE, WARMUP_FOLDER, GeneratedModel
from rfm_export.pbtxt import parse, render, serving_versions


@contextmanager
def staging(repository: Path) -> Iterator[Path]:
    """A folder on the repository's file system, gone afterwards: beside it, or in it where it is a mount point."""
    repository.mkdir(parents=True, exist_ok=True)
    repository = repository.resolve()
    beside = repository.parent.stat().st_dev == repository.stat().st_dev
    parent = repository.parent if beside else repository
    folder = Path(tempfile.mkdtemp(prefix=f".{repository.name}.export-", dir=parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


def next_version(repository: Path, names: Sequence[str]) -> int:
    """One more than the highest version of any of the models."""
    folders = (path for name in names for path in (repository / name).glob("*"))
    return 1 + max((int(path.name) for path in folders if path.name.isdecimal()), default=0)


def read_config(repository: Path, name: str) -> pb.ModelConfig:
    """The configuration that stands in the repository. Raises OSError, google.protobuf.text_format.ParseError."""
    return parse((repository / name / CONFIG_FILE).read_text())


def publish(repository: Path, staged: Path, models: Sequence[GeneratedModel]) -> None:
    """Moves the staged models into the repository.

    A model that is not there yet appears whole. One that is first serves its old and its new version, then the
    ensembles switch to the new one, then the old one goes.
    """
    replaced = [model for model in models if (repository / model.name).exists()]
    for model in models:
        if model not in replaced:
            (staged / model.name).rename(repository / model.name)
            continue
        (staged / model.name / str(model.version)).rename(repository / model.name / str(model.version))
        for file in model.warmup_files:
            target = repository / model.name / WARMUP_FOLDER
            target.mkdir(exist_ok=True)
            (staged / model.name / WARMUP_FOLDER / file).replace(target / file)

    parts = [model for model in replaced if not model.is_ensemble]
    for model in parts:
        served = read_config(repository, model.name).version_policy.specific.versions
        _replace_config(repository, serving_versions(model.config, sorted({*served, model.version})), staged)
    for model in (*(model for model in replaced if model.is_ensemble), *parts):
        _replace_config(repository, model.config, staged)


def _replace_config(repository: Path, config: pb.ModelConfig, scratch: Path) -> None:
    """Readers see the old configuration or the new, never a part; ``scratch`` is on the same file system."""
    (scratch / CONFIG_FILE).write_text(render(config))
    (scratch / CONFIG_FILE).replace(repository / config.name / CONFIG_FILE)
