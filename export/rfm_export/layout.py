# SPDX-License-Identifier: MIT
"""The models that serve a checkpoint, and every generated file of them.

ReWiND: ``<name>`` scores embeddings. With encoders there are also ``<name>_encoder`` and ``<name>_frames``, the
ensemble of the two that scores raw frames. Vision-language: ``<name>_frames`` alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources

import numpy as np
from tritonclient.grpc import model_config_pb2 as pb

from rfm.config import ServeConfig
from rfm.rewind.network import RewindConfig
from rfm.vlm.family import SMOL_SIZE_PX
from rfm.vlm.images import FRAMES_PER_GROUP, MERGE, fitted_size
from rfm.vlm.network import SMOL, VlmConfig
from rfm_client.contract import PreferenceSample, ProgressSample, Sample, SimilaritySample, Trajectory, wire
from rfm_client.contract.frame_size import FrameSize
from rfm_client.contract.model_info import FRAME_SIZE_PARAMETER, FRAMES_PER_VALUE_PARAMETER, MAX_FRAMES_PARAMETER
from rfm_client.contract.names import encoder_name, frames_name
from rfm_export.about import about_encoders
from rfm_export.pbtxt import Interface, Warmup, ensemble_config, python_config, render

CONFIG_FILE = "config.pbtxt"
MODEL_FILE = "model.py"
WARMUP_FOLDER = "warmup"
KEEP_FILE = ".keep"  # Triton wants an ensemble's version folder, and git forgets empty ones

WARMUP_FRAMES = 2
WARMUP_SIZE_PX = 64


@dataclass(frozen=True)
class GeneratedModel:
    """A model's configuration and files, but for its weights.

    model_file: content of its model.py; None for an ensemble
    warmup_files: contents by name
    """

    config: pb.ModelConfig
    version: int
    model_file: bytes | None = None
    warmup_files: dict[str, bytes] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Its name in the repository."""
        return str(self.config.name)

    @property
    def is_ensemble(self) -> bool:
        """Whether it is made of other models."""
        return self.model_file is None

    def files(self) -> dict[str, bytes]:
        """Contents by path in the repository."""
        in_version = (KEEP_FILE, b"") if self.model_file is None else (MODEL_FILE, self.model_file)
        contents = {CONFIG_FILE: render(self.config).encode(), f"{self.version}/{in_version[0]}": in_version[1]}
        contents |= {f"{WARMUP_FOLDER}/{name}": content for name, content in self.warmup_files.items()}
        return {f"{self.name}/{path}": content for path, content in contents.items()}


def rewind_models(
    config: RewindConfig,
    serve: ServeConfig,
    about: Mapping[str, str],
    *,
    num_gpus: int,
    version: int,
    frame_size: FrameSize | None,
) -> list[GeneratedModel]:
    """The models of a checkpoint; an ensemble stands behind what it is made of.

    about: parameters that tell which checkpoint it is
    frame_size: to what its encoders bring each frame; None: it has no encoders
    """
    dims = config.video_feature_dim, config.text_feature_dim
    outputs = wire.score_outputs(config.progress_bins if config.progress_bins > 1 else None)
    limit = min((n for n in (config.trained_frames, config.max_frames) if n is not None), default=None)
    scorer = Interface(serve.name, wire.embedding_inputs(*dims), outputs, {**_limits(limit), **about})
    models = [
        _python_model(
            scorer, "rfm", serve, num_gpus, version, _warmups(_warmup_embeddings(config), config.has_similarity)
        )
    ]
    if frame_size is not None:
        encoder = Interface(
            encoder_name(serve.name), wire.encoder_inputs(), wire.encoder_outputs(*dims), about_encoders(about)
        )
        frames = Interface(
            frames_name(serve.name), wire.frame_inputs(), outputs, {**_limits(limit, frame_size), **about}
        )
        models.append(_python_model(encoder, "rfm_encoder", serve, num_gpus, version, [_encoder_warmup()]))
        models.append(GeneratedModel(ensemble_config(frames, serve, version, encoder, scorer), version))
    return models


def vlm_models(
    config: VlmConfig, serve: ServeConfig, about: Mapping[str, str], *, num_gpus: int, version: int
) -> list[GeneratedModel]:
    """The one model of a vision-language checkpoint."""
    outputs = wire.score_outputs(config.progress_bins if config.progress_bins > 1 else None)
    limits = _limits(config.trained_frames, _frame_size(config), 1 if config.multi_image else FRAMES_PER_GROUP)
    frames = Interface(frames_name(serve.name), wire.frame_inputs(), outputs, {**limits, **about})
    warmups = _warmups(_warmup_frames(), config.has_similarity)
    return [_python_model(frames, "rfm", serve, num_gpus, version, warmups)]


def _limits(max_frames: int | None, frame_size: FrameSize | None = None, frames_per_value: int = 1) -> dict[str, str]:
    """What a client may want to know before it sends a trajectory; empty: no limit."""
    return {
        MAX_FRAMES_PARAMETER: "" if max_frames is None else str(max_frames),
        FRAME_SIZE_PARAMETER: "" if frame_size is None else str(frame_size),
        FRAMES_PER_VALUE_PARAMETER: str(frames_per_value),
    }


def _frame_size(config: VlmConfig) -> FrameSize | None:
    if config.family == SMOL:
        return FrameSize("longest", (SMOL_SIZE_PX,))
    if config.size_px is None:
        return None
    vision = config.backbone["vision_config"]
    factor = vision["patch_size"] * MERGE * (1 if config.multi_image else FRAMES_PER_GROUP)
    return FrameSize("exact", fitted_size(*config.size_px, factor))  # the first size to which the server resizes


def _python_model(
    interface: Interface, template: str, serve: ServeConfig, num_gpus: int, version: int, warmups: list[Warmup]
) -> GeneratedModel:
    model_file = resources.files("rfm_export") / "templates" / template / MODEL_FILE
    files = {name: content for warmup in warmups for name, content in warmup.files().items()}
    config = python_config(interface, serve, num_gpus, version, warmups)
    return GeneratedModel(config, version, model_file.read_bytes(), files)


def _warmups(trajectory: Trajectory, has_similarity: bool) -> list[Warmup]:
    """One sample of each type that the checkpoint can score."""
    samples: dict[str, Sample] = {
        "progress": ProgressSample(trajectory),
        "preference": PreferenceSample(trajectory, trajectory),
    }
    if has_similarity:
        samples["similarity"] = SimilaritySample(trajectory, trajectory)
    return [Warmup(name, wire.encode_samples([sample])) for name, sample in samples.items()]


def _warmup_embeddings(config: RewindConfig) -> Trajectory:
    return Trajectory(
        video_embeddings=np.zeros((WARMUP_FRAMES, config.video_feature_dim), np.float32),
        text_embedding=np.zeros(config.text_feature_dim, np.float32),
    )


def _warmup_frames() -> Trajectory:
    return Trajectory(frames=np.zeros((WARMUP_FRAMES, WARMUP_SIZE_PX, WARMUP_SIZE_PX, 3), np.uint8), task="warm up")


def _encoder_warmup() -> Warmup:
    return Warmup("frames", wire.encode_frames(_warmup_frames()))
