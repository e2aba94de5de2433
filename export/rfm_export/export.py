# SPDX-License-Identifier: MIT
"""``rfm export``: a checkpoint becomes the next version of its models in a Triton model repository."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from google.protobuf.text_format import ParseError

from rfm import checkpoint as checkpoints
from rfm.checkpoint import RewindCheckpoint
from rfm.config import ServeConfig
from rfm.engine import Engine
from rfm.models.encoders import Encoders
from rfm_export.errors import ExportError
from rfm_export.layout import GeneratedModel, encoder_name, frames_name, rewind_models
from rfm_export.publish import next_version, publish, read_config, staging
from rfm_export.verify import probes, verify

CHECKPOINT_FOLDER = "checkpoint"
IMAGE_ENCODER_FOLDER = "image_encoder"
TEXT_ENCODER_FOLDER = "text_encoder"

# What upstream's checkpoints with encoders were trained from.
DEFAULT_IMAGE_ENCODER = "facebook/dinov2-base"
DEFAULT_TEXT_ENCODER = "sentence-transformers/all-MiniLM-L12-v2"


def export(source: str | Path, repository: Path, serve: ServeConfig) -> int:
    """Writes the checkpoint at ``source`` into ``repository`` and gives its version number.

    The staged files are loaded and compared with the original before anything in the repository changes.
    Raises CheckpointError, ExportError.
    """
    checkpoint = checkpoints.load(source)
    encoders = load_encoders(checkpoint, serve)
    version = next_version(repository, [serve.name, encoder_name(serve.name), frames_name(serve.name)])
    models = rewind_models(
        checkpoint.config, serve, num_gpus=_num_gpus(serve), version=version, with_encoders=encoders is not None
    )
    _check_replaceable(repository, models, serve)
    with staging(repository) as folder:
        for path, content in (item for model in models for item in model.files().items()):
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(content)
        scorer = folder / serve.name / str(version)
        checkpoints.save(checkpoint, scorer / CHECKPOINT_FOLDER)
        exported_encoders = None
        if encoders is not None:
            parts = folder / encoder_name(serve.name) / str(version)
            encoders.save_pretrained(parts / IMAGE_ENCODER_FOLDER, parts / TEXT_ENCODER_FOLDER)
            exported_encoders = Encoders.from_pretrained(parts / IMAGE_ENCODER_FOLDER, parts / TEXT_ENCODER_FOLDER)
        original = Engine(checkpoint.build(), encoders=encoders)
        exported = Engine(checkpoints.load(scorer / CHECKPOINT_FOLDER).build(), encoders=exported_encoders)
        verify(original, exported, probes(checkpoint.config, with_frames=encoders is not None))
        publish(repository, folder, models)
    return version


def check(repository: Path, serve: ServeConfig) -> list[str]:
    """How the repository's generated files differ from what an export would write now; empty if they do not."""
    versions = _read_config(repository, serve.name).version_policy.specific.versions
    if not versions:
        raise ExportError(f"{repository / serve.name}: expected a configuration that names its versions, got none")
    version = max(versions)
    checkpoint = checkpoints.load(repository / serve.name / str(version) / CHECKPOINT_FOLDER)
    models = rewind_models(
        checkpoint.config,
        serve,
        num_gpus=_num_gpus(serve),
        version=version,
        with_encoders=(repository / encoder_name(serve.name)).exists(),
    )
    differences = []
    for path, content in (item for model in models for item in model.files().items()):
        if not (repository / path).is_file():
            differences.append(f"{repository / path}: is missing")
        elif (repository / path).read_bytes() != content:
            differences.append(f"{repository / path}: differs from what `rfm export` generates")
    return differences


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


def _num_gpus(serve: ServeConfig) -> int:
    return torch.cuda.device_count() if serve.num_gpus is None else serve.num_gpus


def _read_config(repository: Path, name: str) -> Any:
    try:
        return read_config(repository, name)
    except (OSError, ParseError) as error:
        raise ExportError(f"{repository / name}: expected an exported model, got {error}") from error


def _check_replaceable(repository: Path, models: Sequence[GeneratedModel], serve: ServeConfig) -> None:
    """A model keeps its inputs and outputs from version to version; its clients rely on them."""
    names = {model.name for model in models}
    if frames_name(serve.name) not in names and (repository / frames_name(serve.name)).exists():
        raise ExportError(
            f"{repository / frames_name(serve.name)} scores raw frames, which this checkpoint cannot without "
            "--image-encoder and --text-encoder; give them, or another --name"
        )
    for model in models:
        if not (repository / model.name).exists():
            continue
        there = _read_config(repository, model.name)
        for kind in ("input", "output"):
            expected, got = ([str(t) for t in getattr(config, kind)] for config in (there, model.config))
            if expected != got:
                raise ExportError(
                    f"{repository / model.name}: expected a checkpoint with the same {kind}s as its other versions, "
                    "got one with different shapes; choose another --name or --repository"
                )
