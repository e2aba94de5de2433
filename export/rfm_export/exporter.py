# SPDX-License-Identifier: MIT
"""``rfm export``: write a checkpoint into a Triton model repository, as the next version of its models."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from google.protobuf.text_format import ParseError
from safetensors import SafetensorError

from rfm import families, published
from rfm.config import ExportConfig
from rfm.parameters import CHECKPOINT_FOLDER, FAMILY_PARAMETER
from rfm.published.provenance import write
from rfm.serve.repository import CONFIG_FILE
from rfm_client.contract import FRAME_SCORES, wire
from rfm_client.contract.wire import encoder_name, frames_name
from rfm_export.errors import ExportError
from rfm_export.layout import GeneratedModel, Version, description_in, generated_files, generated_models
from rfm_export.publish import alone, next_version, publish, read_config, staging
from rfm_export.source import (
    Printer,
    Source,
    described,
    described_encoders,
    num_gpus,
    origin_in,
    read_for_export,
    with_batch_size,
)
from rfm_export.verify import compare, device_of


def _nobody(line: str) -> None:
    pass


def export(
    source: str | Path,
    repository: Path,
    settings: ExportConfig,
    *,
    other_machine: bool = False,
    family: str | None = None,
    device: str | None = None,
    say: Printer = _nobody,
    begin: Printer = _nobody,
) -> int:
    """Write the checkpoint at ``source`` into ``repository``, and return its version number.

    The staged files are loaded and compared with the checkpoint before the repository changes.

    other_machine: True: another machine serves the export, so ``num_gpus`` may exceed this machine's GPUs
    family: package of the checkpoint's family, which the server must also be able to import; None: a built-in family
    device: where scores are compared; None: the CPU, for a large network a GPU with enough free memory
    say: receives lines for the user: the run's config.yaml, ``rfm.published.notes``, a derived ``max_batch_size``
    begin: receives each step that may take minutes, as it begins

    Raises CheckpointError, ExportError.
    """
    begin("reading the checkpoint")
    read = read_for_export(source, settings, family, device, say, other_machine=other_machine)
    names = [settings.name, encoder_name(settings.name), frames_name(settings.name)]
    with alone(repository), staging(repository, names) as staged:
        version = Version(next_version(repository, names), read.settings, read.num_gpus, read.family.name)
        models = generated_models(read.description, read.of_encoders, version)
        _check_replaceable(repository, models, settings)
        begin(f"writing version {version.number}")
        with _needing_disk(repository):
            _save(read, version, staged)
        on = device_of(read)
        begin(f"comparing the export's scores with the checkpoint's on {on}")
        if (difference := compare(read, version, staged, on, say)) is not None:
            description = replace(read.description, weights_difference=difference)
            models = generated_models(description, read.of_encoders, version)
        with _needing_disk(repository):
            publish(repository, staged, models)
    return version.number


@contextmanager
def _needing_disk(repository: Path) -> Iterator[None]:
    """Raise ExportError if the repository's disk is full."""
    try:
        yield
    except (OSError, SafetensorError) as error:  # safetensors reports a full disk as SafetensorError
        kept = "the versions that are served stay as they are; make room there, or name another --repository"
        raise ExportError.at(repository, "room for the exported files", error, kept) from error


def _save(source: Source, version: Version, staged: Path) -> None:
    folder = version.checkpoint_folder(source.checkpoint.description, staged)
    source.checkpoint.save(folder)
    write(source.assumptions, source.description.computation, folder)
    if source.encoders is not None:
        source.encoders.save(version.encoders_folder(staged))


def check(repository: Path, settings: ExportConfig) -> list[str]:
    """Return a line per generated file that an export would now write differently. Raises ExportError."""
    scorer = settings.name if (repository / settings.name).exists() else frames_name(settings.name)
    config = _read_config(repository, scorer)
    try:
        origin = origin_in(description_in(config))
    except ValueError as error:
        raise ExportError(f"{error}; export again", repository / scorer / CONFIG_FILE) from error
    versions = config.version_policy.specific.versions
    if not versions:
        raise ExportError.at(repository / scorer, "a configuration that names its versions", "none")
    number = max(versions)
    folder = repository / scorer / str(number) / CHECKPOINT_FOLDER
    family = published.choose(folder, config.parameters[FAMILY_PARAMETER].string_value or None)
    checkpoint = families.load(folder, family=family.name)
    description = described(checkpoint, origin)
    if settings.weights not in (None, description.weights):  # a new export would rewrite them
        remedy, got = "leave out --weights, or export again", description.weights or "full ones"
        raise ExportError.at(folder, f"weights in {settings.weights}", got, remedy)
    settings = with_batch_size(settings, checkpoint, _nobody)
    encoders = repository / encoder_name(settings.name) / str(number)
    of_encoders = family.encoders.describe(encoders) if family.encoders is not None and encoders.exists() else None
    of_encoders = None if of_encoders is None else described_encoders(of_encoders, origin)
    version = Version(number, settings, num_gpus(settings), family.name)
    models = generated_models(description, of_encoders, version)
    differences = []
    for path, content in generated_files(models, repository).items():
        if not (repository / path).is_file():
            differences.append(f"{repository / path}: is missing")
        elif (repository / path).read_bytes() != content:
            differences.append(f"{repository / path}: differs from what `rfm export` generates")
    return differences


def _read_config(repository: Path, name: str) -> Any:
    try:
        return read_config(repository, name)
    except (OSError, ParseError) as error:
        raise ExportError.at(repository / name, "an exported model", error) from error


def _check_replaceable(repository: Path, models: Sequence[GeneratedModel], settings: ExportConfig) -> None:
    """Raise ExportError for a model that would lose inputs or outputs on which clients rely.

    A model may gain an optional input, and a score that is newer than some exports (``Score.is_newer``), which clients
    need not know. It may lose the frame-digest input, without which clients send pixels.
    """
    names = {model.name for model in models}
    for name in (settings.name, encoder_name(settings.name), frames_name(settings.name)):
        if name not in names and (repository / name).exists():
            encoders = "of a ReWiND checkpoint, name its encoders (--image-encoder, --text-encoder)"
            remedy = f"choose another --repository or --name, or, {encoders}"
            expected = "a checkpoint that this model can serve too"
            raise ExportError.at(repository / name, expected, "one that it cannot", remedy)
    for model in models:
        if not (repository / model.name).exists():
            continue
        there = _read_config(repository, model.name)
        known, kept = ({tensor.name for tensor in config.input} for config in (there, model.config))
        inputs = [tensor for tensor in model.config.input if tensor.name in known or not tensor.optional]
        asked = [tensor for tensor in there.input if tensor.name in kept or tensor.name != wire.FRAME_DIGESTS]
        newer = {name for name, score in FRAME_SCORES.items() if score.is_newer}
        given = newer - {tensor.name for tensor in there.output}
        outputs = [tensor for tensor in model.config.output if tensor.name not in given]
        for kind, before, after in (("input", asked, inputs), ("output", there.output, outputs)):
            if list(before) != list(after):
                expected = f"a checkpoint with the same {kind}s as its other versions"
                remedy = "choose another --name or --repository"
                raise ExportError.at(repository / model.name, expected, "one with different shapes", remedy)
