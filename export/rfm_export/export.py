# SPDX-License-Identifier: MIT
"""``rfm export``: a checkpoint becomes the next version of its models in a Triton model repository."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from google.protobuf.text_format import ParseError
from safetensors import SafetensorError

from rfm import families
from rfm.checkpoint.content import read_json
from rfm.checkpoint.preprocessor import PREPROCESSOR_CONFIG
from rfm.config import ServeConfig
from rfm.engine import PROCESSOR_FOLDER, Engine
from rfm.families import Checkpoint
from rfm.rewind.checkpoint import RewindCheckpoint
from rfm.rewind.encoders import Encoders, ImagePreprocessor
from rfm.vlm.checkpoint import VlmCheckpoint
from rfm.vlm.family import load_collator, save_processor
from rfm_client.contract.frame_size import FrameSize
from rfm_client.contract.names import encoder_name, frames_name
from rfm_export.about import Origin, about, tell_weights
from rfm_export.errors import ExportError
from rfm_export.layout import GeneratedModel, rewind_models, vlm_models
from rfm_export.publish import alone, next_version, publish, read_config, staging
from rfm_export.verify import probes, verify

CHECKPOINT_FOLDER = "checkpoint"
IMAGE_ENCODER_FOLDER = "image_encoder"
TEXT_ENCODER_FOLDER = "text_encoder"

# What upstream's checkpoints with encoders were trained from.
DEFAULT_IMAGE_ENCODER = "facebook/dinov2-base"
DEFAULT_TEXT_ENCODER = "sentence-transformers/all-MiniLM-L12-v2"


@dataclass(frozen=True)
class _Plan:
    """How one checkpoint is exported.

    write: puts weights and what goes with them into a staged repository
    original, exported: engines of the checkpoint, and of what was staged; made when needed, since both may be large
    """

    models: list[GeneratedModel]
    write: Callable[[Path], None]
    original: Callable[[], Engine]
    exported: Callable[[Path], Engine]
    embeddings: bool
    frames: bool


def export(source: str | Path, repository: Path, serve: ServeConfig, *, other_machine: bool = False) -> int:
    """Writes the checkpoint at ``source`` into ``repository`` and gives its version number.

    The staged files are loaded and compared with the original before anything in the repository changes.
    other_machine: it is to be served elsewhere, so that ``num_gpus`` may be more than there are here
    Raises CheckpointError, ExportError.
    """
    if not other_machine:
        _check_gpus(serve.num_gpus)
    folder = families.find(source)
    checkpoint = families.load(folder, base_model=serve.base_model, resize_images=serve.resize_images)
    families.check(folder, checkpoint)
    origin = Origin.of(source, folder)
    names = [serve.name, encoder_name(serve.name), frames_name(serve.name)]
    with alone(repository), staging(repository, names) as staged:
        version = next_version(repository, names)
        if isinstance(checkpoint, RewindCheckpoint):
            plan = _rewind_plan(checkpoint, serve, version, origin)
        else:
            plan = _vlm_plan(checkpoint, serve, version, origin, folder)
        _check_replaceable(repository, plan.models, serve)
        _stage(plan, staged)
        samples = probes(checkpoint.config, with_embeddings=plan.embeddings, with_frames=plan.frames)
        verify(plan.original, lambda: plan.exported(staged), samples)
        publish(repository, staged, plan.models)
    return version


def _check_gpus(num_gpus: int | None) -> None:
    """Raises ExportError for more GPUs than this machine has: Triton would refuse to load the models."""
    there = torch.cuda.device_count()
    if num_gpus is not None and num_gpus > there:
        raise ExportError(
            f"num_gpus: expected at most {there}, got {num_gpus}; --other-machine exports for a machine with more GPUs"
        )


def _stage(plan: _Plan, staged: Path) -> None:
    try:
        plan.write(staged)
        for path, content in _generated(plan.models, staged).items():
            (staged / path).parent.mkdir(parents=True, exist_ok=True)
            (staged / path).write_bytes(content)
    except (OSError, SafetensorError) as error:  # the latter of a full disk, too
        raise ExportError(f"{staged}: expected room for the exported files, got: {error}") from error


def check(repository: Path, serve: ServeConfig) -> list[str]:
    """How the repository's generated files differ from what an export would write now; empty if they do not."""
    scorer = serve.name if (repository / serve.name).exists() else frames_name(serve.name)
    config = _read_config(repository, scorer)
    versions = config.version_policy.specific.versions
    if not versions:
        raise ExportError(f"{repository / scorer}: expected a configuration that names its versions, got none")
    version = max(versions)
    checkpoint = families.load(repository / scorer / str(version) / CHECKPOINT_FOLDER)
    frame_size = _exported_frame_size(repository / encoder_name(serve.name) / str(version))
    models = _models(checkpoint, serve, version, frame_size, Origin.told(config))
    differences = []
    for path, content in _generated(models, repository).items():
        if not (repository / path).is_file():
            differences.append(f"{repository / path}: is missing")
        elif (repository / path).read_bytes() != content:
            differences.append(f"{repository / path}: differs from what `rfm export` generates")
    return differences


def _generated(models: Sequence[GeneratedModel], repository: Path) -> dict[str, bytes]:
    """Contents of the generated files by path in the repository, where the models' weights lie."""
    for model in models:
        tell_weights(model.config, model.version, repository)
    return {path: content for model in models for path, content in model.files().items()}


def load_encoders(checkpoint: RewindCheckpoint, serve: ServeConfig) -> Encoders | None:
    """The encoders of a checkpoint that has them, or for which ``serve`` names them; else None.

    Raises ExportError if they cannot be had or do not fit the network.
    """
    in_checkpoint = bool(checkpoint.image_encoder or checkpoint.text_encoder)
    if not (in_checkpoint or serve.image_encoder or serve.text_encoder):
        return None
    image_source, text_source = serve.image_encoder or DEFAULT_IMAGE_ENCODER, serve.text_encoder or DEFAULT_TEXT_ENCODER
    try:
        encoders = Encoders.from_pretrained(
            image_source,
            text_source,
            image_weights=checkpoint.image_encoder or None,
            text_weights=checkpoint.text_encoder or None,
        )
    except (ImportError, OSError, ValueError) as error:
        hint = "name local folders with --image-encoder and --text-encoder"
        raise ExportError(f"encoders {image_source} and {text_source}: {error} ({hint})") from error
    widths = (encoders.video_feature_dim, encoders.text_feature_dim)
    expected = (checkpoint.config.video_feature_dim, checkpoint.config.text_feature_dim)
    if widths != expected:
        raise ExportError(f"encoders {image_source} and {text_source}: expected widths {expected}, got {widths}")
    return encoders


def _exported_frame_size(encoder: Path) -> FrameSize | None:
    """To what the encoders of an exported version bring each frame; None: it has none."""
    file = encoder / IMAGE_ENCODER_FOLDER / PREPROCESSOR_CONFIG
    return ImagePreprocessor.from_config(read_json(file), str(file)).frame_size if file.exists() else None


def _models(
    checkpoint: Checkpoint, serve: ServeConfig, version: int, frame_size: FrameSize | None, origin: Origin
) -> list[GeneratedModel]:
    told = about(checkpoint, origin)
    num_gpus = torch.cuda.device_count() if serve.num_gpus is None else serve.num_gpus
    if isinstance(checkpoint, VlmCheckpoint):
        return vlm_models(checkpoint.config, serve, told, num_gpus=num_gpus, version=version)
    return rewind_models(checkpoint.config, serve, told, num_gpus=num_gpus, version=version, frame_size=frame_size)


def _rewind_plan(checkpoint: RewindCheckpoint, serve: ServeConfig, version: int, origin: Origin) -> _Plan:
    encoders = load_encoders(checkpoint, serve)

    def of_scorer(folder: Path) -> Path:
        return folder / serve.name / str(version) / CHECKPOINT_FOLDER

    def of_encoders(folder: Path) -> tuple[Path, Path]:
        parts = folder / encoder_name(serve.name) / str(version)
        return parts / IMAGE_ENCODER_FOLDER, parts / TEXT_ENCODER_FOLDER

    def write(folder: Path) -> None:
        families.save(checkpoint, of_scorer(folder))
        if encoders is not None:
            encoders.save_pretrained(*of_encoders(folder))

    def exported(folder: Path) -> Engine:
        saved = Encoders.from_pretrained(*of_encoders(folder)) if encoders is not None else None
        return Engine.from_checkpoint(of_scorer(folder), encoders=saved)

    return _Plan(
        models=_models(checkpoint, serve, version, encoders.preprocessor.frame_size if encoders else None, origin),
        write=write,
        original=lambda: Engine.of(checkpoint, encoders=encoders),
        exported=exported,
        embeddings=True,
        frames=encoders is not None,
    )


def _vlm_plan(checkpoint: VlmCheckpoint, serve: ServeConfig, version: int, origin: Origin, folder: Path) -> _Plan:
    """folder: the checkpoint's."""
    processor: str | Path = serve.base_model or checkpoint.config.base_model_id
    if serve.base_model is None and (folder / PROCESSOR_FOLDER).is_dir():
        processor = folder / PROCESSOR_FOLDER
    collator = load_collator(checkpoint, processor)

    def of_scorer(folder: Path) -> Path:
        return folder / frames_name(serve.name) / str(version) / CHECKPOINT_FOLDER

    def write(folder: Path) -> None:
        families.save(checkpoint, of_scorer(folder))
        save_processor(collator, of_scorer(folder) / PROCESSOR_FOLDER)

    device = "cuda" if torch.cuda.is_available() and serve.num_gpus != 0 else "cpu"
    return _Plan(
        models=_models(checkpoint, serve, version, None, origin),
        write=write,
        original=lambda: Engine.of(checkpoint, processor=processor, device=device, dtype=serve.torch_dtype),
        exported=lambda folder: Engine.from_checkpoint(of_scorer(folder), device=device, dtype=serve.torch_dtype),
        embeddings=False,
        frames=True,
    )


def _read_config(repository: Path, name: str) -> Any:
    try:
        return read_config(repository, name)
    except (OSError, ParseError) as error:
        raise ExportError(f"{repository / name}: expected an exported model, got {error}") from error


def _check_replaceable(repository: Path, models: Sequence[GeneratedModel], serve: ServeConfig) -> None:
    """A model keeps its inputs and outputs from version to version; its clients rely on them.

    What those need not know, an optional input, it may gain.
    """
    names = {model.name for model in models}
    for name in (serve.name, encoder_name(serve.name), frames_name(serve.name)):
        if name not in names and (repository / name).exists():
            raise ExportError(
                f"{repository / name}: expected a checkpoint that this model can serve too, got one that it cannot; "
                "choose another --repository or --name, or, of a ReWiND checkpoint, name its encoders "
                "(--image-encoder, --text-encoder)"
            )
    for model in models:
        if not (repository / model.name).exists():
            continue
        there = _read_config(repository, model.name)
        known = {tensor.name for tensor in there.input}
        inputs = [tensor for tensor in model.config.input if tensor.name in known or not tensor.optional]
        for kind, before, after in (("input", there.input, inputs), ("output", there.output, model.config.output)):
            if list(before) != list(after):
                raise ExportError(
                    f"{repository / model.name}: expected a checkpoint with the same {kind}s as its other versions, "
                    "got one with different shapes; choose another --name or --repository"
                )
