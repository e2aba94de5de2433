# SPDX-License-Identifier: MIT
"""``rfm export``: write a checkpoint into a Triton model repository, as the next version of its models."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import torch
from google.protobuf.text_format import ParseError
from safetensors import SafetensorError

from rfm import families
from rfm.checkpoint.hub import check_links
from rfm.checkpoint.provenance import Decision, write
from rfm.checkpoint.run_config import find_run_config
from rfm.config import ExportConfig
from rfm.engine import Engine
from rfm.engine.computation import computation
from rfm.family import Checkpoint, Description, Family, FrameEncoders, Options
from rfm.parameters import CHECKPOINT_FOLDER, FAMILY_PARAMETER
from rfm_client.contract import wire
from rfm_client.contract.model_info import COMPUTATION_PARAMETER, WEIGHTS_DIFFERENCE_PARAMETER
from rfm_client.contract.names import encoder_name, frames_name
from rfm_export.about import about, origin_in, origin_of, record_digests
from rfm_export.batches import with_batch_size
from rfm_export.errors import ExportError
from rfm_export.layout import GeneratedModel, Version, generated_models, scorer_name
from rfm_export.publish import alone, next_version, publish, read_config, staging
from rfm_export.verify import (
    device_for,
    device_named,
    largest_difference,
    needing_room,
    probes,
    verify,
    verify_graphs,
)

Say: TypeAlias = Callable[[str], object]  # takes a line for the user


def _nobody(line: str) -> None:
    pass


@dataclass(frozen=True)
class _Source:
    """The checked input of an export.

    decisions: settings that the scores depend on
    full: loads the checkpoint with full weights; None: the settings round nothing
    """

    family: Family
    checkpoint: Checkpoint
    encoders: FrameEncoders | None
    origin: Mapping[str, str]
    decisions: Sequence[Decision] = ()
    full: Callable[[], Checkpoint] | None = None


def export(
    source: str | Path,
    repository: Path,
    settings: ExportConfig,
    *,
    other_machine: bool = False,
    family: str | None = None,
    device: str | None = None,
    say: Say = _nobody,
) -> int:
    """Write the checkpoint at ``source`` into ``repository``, and return its version number.

    The staged files are loaded and compared with the checkpoint before the repository changes.

    other_machine: True: another machine serves it, so ``num_gpus`` may exceed the GPUs of this machine
    family: package of the checkpoint's family, which the server must also be able to import; None: a built-in family
    device: for the comparison of scores; None: the CPU, for a large network a GPU with room for it
    say: takes a line for the user: the run's config.yaml, ``rfm.families.notes``, a derived ``max_batch_size``, the
        device of a large network

    Raises CheckpointError, ExportError.
    """
    if not other_machine:
        _check_gpus(settings.num_gpus)
    named = None if device is None else device_named(device)
    loaded = _load(source, settings, family, say)
    _check_graphs(settings, loaded.checkpoint.description)
    settings = with_batch_size(settings, loaded.checkpoint, say)
    described = loaded.encoders.description if loaded.encoders is not None else None
    names = [settings.name, encoder_name(settings.name), frames_name(settings.name)]
    with alone(repository), staging(repository, names) as staged:
        version = _version(loaded, settings, next_version(repository, names))
        models = generated_models(loaded.checkpoint.description, described, version)
        _check_replaceable(repository, models, settings)
        if (differs := _difference(loaded, version, named, say)) is not None:
            version = replace(version, about={**version.about, WEIGHTS_DIFFERENCE_PARAMETER: differs})
            models = generated_models(loaded.checkpoint.description, described, version)
        with _needing_disk(repository):
            _stage(loaded, models, version, staged)
        _verify(loaded, version, staged, named, say)
        with _needing_disk(repository):
            publish(repository, staged, models)
    return version.number


def explain(
    source: str | Path,
    settings: ExportConfig,
    *,
    family: str | None = None,
    say: Say = _nobody,
) -> Sequence[Decision]:
    """Return all settings that the scores of the checkpoint at ``source`` depend on, with sources. Write nothing.

    Parameters as of ``export``. Raises CheckpointError.
    """
    return _load(source, settings, family, say).decisions


def _load(source: str | Path, settings: ExportConfig, family: str | None, say: Say) -> _Source:
    """Load and check ``source``. Tell the user the file of the training run's settings, and possible faults."""
    folder = families.find(source, say)
    options = Options.of(settings)
    kind = families.choose(folder, family, options)
    checkpoint = families.load_from(folder, kind, options)
    check_links(folder)
    encoders = checkpoint.encoders()
    if (run_config := find_run_config(folder)) is not None:
        say(f"{run_config}: read as the settings of the training run")
    for note in families.notes(folder, checkpoint):
        say(note)
    told = [] if settings.dtype is None else [Decision("served_dtype", settings.dtype, "--dtype")]
    computed = computation(checkpoint, settings.torch_dtype, on_gpu=_num_gpus(settings) > 0)
    told.append(Decision(COMPUTATION_PARAMETER, computed, "installed PyTorch"))
    origin = {**origin_of(source, folder), COMPUTATION_PARAMETER: computed}
    full = (
        None if options.weights is None else partial(families.load_from, folder, kind, replace(options, weights=None))
    )
    return _Source(kind, checkpoint, encoders, origin, [*checkpoint.decisions(), *told], full)


def _check_gpus(num_gpus: int | None) -> None:
    """Raise ExportError for more GPUs than this machine has: Triton would refuse to load the models."""
    there = torch.cuda.device_count()
    if num_gpus is not None and num_gpus > there:
        remedy = "--other-machine exports for a machine with more, --num-gpus 0 for the CPU"
        raise ExportError.at("num_gpus", f"at most {there}", num_gpus, remedy)


def _check_graphs(settings: ExportConfig, description: Description) -> None:
    """Raise ExportError if CUDA graphs are on but nothing would use them."""
    if settings.cuda_graphs and not description.uses_graphs:
        expected = "an RFM, Robometer or RoboReward checkpoint (its expected score) on a Qwen backbone"
        raise ExportError.at("cuda_graphs", expected, "another", "leave out --cuda-graphs")
    if settings.cuda_graphs and not _num_gpus(settings):
        remedy = "leave out --cuda-graphs, or name --num-gpus with --other-machine"
        raise ExportError.at("cuda_graphs", "an export for GPUs", "one for the CPU", remedy)


@contextmanager
def _needing_disk(repository: Path) -> Iterator[None]:
    """Raise ExportError if the repository's disk is full."""
    try:
        yield
    except (OSError, SafetensorError) as error:  # safetensors reports a full disk as SafetensorError
        kept = "the versions that are served stay as they are; make room there, or name another --repository"
        raise ExportError.at(repository, "room for the exported files", error, kept) from error


def _stage(source: _Source, models: Sequence[GeneratedModel], version: Version, staged: Path) -> None:
    folder = _checkpoint_folder(source.checkpoint.description, version, staged)
    source.checkpoint.save(folder)
    write(source.decisions, folder)
    if source.encoders is not None:
        source.encoders.save(_encoders_folder(version, staged))
    for path, content in _generated(models, staged).items():
        (staged / path).parent.mkdir(parents=True, exist_ok=True)
        (staged / path).write_bytes(content)


def _difference(source: _Source, version: Version, named: torch.device | None, say: Say) -> str | None:
    """Return the largest difference that rounding the weights makes to progress; None: nothing is rounded."""
    full = None if source.full is None else source.full()
    if full is None or full.config.weights is not None:
        return None
    settings, kind = version.settings, source.checkpoint.config.weights
    device = named or device_for(full, settings.torch_dtype, may_use_gpu=settings.num_gpus != 0)
    engine = partial(Engine.of, device=device, dtype=settings.torch_dtype)
    samples = probes(full.description, with_encoders=False)
    with needing_room(device):
        largest = largest_difference(partial(engine, full), partial(engine, source.checkpoint), samples)
    say(f"--weights {kind}: progress differs by at most {largest:.2g} from the full checkpoint's, on noise")
    return f"{largest:.2g}"


def _verify(source: _Source, version: Version, staged: Path, named: torch.device | None, say: Say) -> None:
    """Raise ExportDiffersError unless the staged files give the checkpoint's scores."""
    description, settings = source.checkpoint.description, version.settings
    dtype = settings.torch_dtype if description.is_large else None
    device = named or device_for(source.checkpoint, dtype, may_use_gpu=settings.num_gpus != 0)
    engine = partial(Engine.of, device=device, dtype=dtype)
    if description.is_large:
        say(f"the export's scores are compared with the checkpoint's on {device} (--device names another one)")

    def exported(*, cuda_graphs: bool = False) -> Engine:
        checkpoint = families.named(source.family.name).load(
            _checkpoint_folder(description, version, staged), Options()
        )
        if source.encoders is None:
            return engine(checkpoint, cuda_graphs=cuda_graphs)
        served_by = families.encoders_of(source.family.name)
        return engine(checkpoint, encoders=served_by.load(_encoders_folder(version, staged)))

    samples = probes(description, with_encoders=source.encoders is not None)
    with needing_room(device):
        original = partial(engine, source.checkpoint, encoders=source.encoders)
        verify(original, exported, samples, may_not_answer=description.may_not_answer)
        if settings.cuda_graphs and device.type == "cuda":
            verify_graphs(partial(exported, cuda_graphs=True), description, say)
        elif settings.cuda_graphs:
            say(f"cuda_graphs: not compared with plain passes: {device} runs no CUDA graphs (--device names a GPU)")


def _checkpoint_folder(description: Description, version: Version, repository: Path) -> Path:
    return repository / scorer_name(description, version.settings.name) / str(version.number) / CHECKPOINT_FOLDER


def _encoders_folder(version: Version, repository: Path) -> Path:
    return repository / encoder_name(version.settings.name) / str(version.number)


def check(repository: Path, settings: ExportConfig) -> list[str]:
    """Return a line for each generated file that an export would now write differently. Raises ExportError."""
    scorer = settings.name if (repository / settings.name).exists() else frames_name(settings.name)
    config = _read_config(repository, scorer)
    versions = config.version_policy.specific.versions
    if not versions:
        raise ExportError.at(repository / scorer, "a configuration that names its versions", "none")
    number = max(versions)
    folder = repository / scorer / str(number) / CHECKPOINT_FOLDER
    family = families.choose(folder, config.parameters[FAMILY_PARAMETER].string_value or None)
    checkpoint = family.load(folder, Options())
    settings = with_batch_size(settings, checkpoint, _nobody)
    encoders = repository / encoder_name(settings.name) / str(number)
    described = family.encoders.describe(encoders) if family.encoders is not None and encoders.exists() else None
    version = _version(_Source(family, checkpoint, None, origin_in(config)), settings, number)
    models = generated_models(checkpoint.description, described, version)
    differences = []
    for path, content in _generated(models, repository).items():
        if not (repository / path).is_file():
            differences.append(f"{repository / path}: is missing")
        elif (repository / path).read_bytes() != content:
            differences.append(f"{repository / path}: differs from what `rfm export` generates")
    return differences


def _generated(models: Sequence[GeneratedModel], repository: Path) -> dict[str, bytes]:
    """Contents of generated files by path, with digests of the weights in ``repository``."""
    for model in models:
        record_digests(model.config, model.version, repository)
    return {path: content for model in models for path, content in model.files().items()}


def _version(source: _Source, settings: ExportConfig, number: int) -> Version:
    about_checkpoint = about(source.checkpoint, source.origin)
    return Version(number, settings, _num_gpus(settings), source.family.name, about_checkpoint)


def _num_gpus(settings: ExportConfig) -> int:
    return torch.cuda.device_count() if settings.num_gpus is None else settings.num_gpus


def _read_config(repository: Path, name: str) -> Any:
    try:
        return read_config(repository, name)
    except (OSError, ParseError) as error:
        raise ExportError.at(repository / name, "an exported model", error) from error


def _check_replaceable(repository: Path, models: Sequence[GeneratedModel], settings: ExportConfig) -> None:
    """Raise ExportError for a model that would lose inputs or outputs, on which its clients rely.

    A model may gain an optional input, and marks of unclear answers, which clients need not know. It may lose the input
    of frames' digests, without which clients send pixels.
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
        given = {wire.UNCLEAR} - {tensor.name for tensor in there.output}
        outputs = [tensor for tensor in model.config.output if tensor.name not in given]
        for kind, before, after in (("input", asked, inputs), ("output", there.output, outputs)):
            if list(before) != list(after):
                expected = f"a checkpoint with the same {kind}s as its other versions"
                remedy = "choose another --name or --repository"
                raise ExportError.at(repository / model.name, expected, "one with different shapes", remedy)
