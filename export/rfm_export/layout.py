# SPDX-License-Identifier: MIT
"""The models that serve a checkpoint, and all their generated files.

A checkpoint that scores embeddings is the model ``<name>``. With encoders there are two more models:
``<name>_encoder``, and ``<name>_frames``, an ensemble that joins the two and scores raw frames. A checkpoint that
scores raw frames is the model ``<name>_frames`` alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path

from tritonclient.grpc import model_config_pb2 as pb

from rfm.config import ExportConfig
from rfm.files import settings_digest, weights_digest
from rfm.parameters import (
    CHECKPOINT_FOLDER,
    DTYPE_PARAMETER,
    FAMILY_PARAMETER,
    FEATURE_CACHE_PARAMETER,
    GRAPHS_PARAMETER,
)
from rfm.serve.repository import CONFIG_FILE, MODEL_FILE
from rfm_client.contract import PreferenceSample, ProgressSample, Sample, SimilaritySample, wire
from rfm_client.contract.description import DESCRIPTION_PARAMETER, Description
from rfm_client.contract.samples import blank_trajectory
from rfm_client.contract.wire import encoder_name, frames_name
from rfm_export.pbtxt import Interface, Warmup, ensemble_config, python_config, render

WARMUP_FOLDER = "warmup"
KEEP_FILE = ".keep"  # Triton needs an ensemble's version folder, but git drops empty folders
# An empty file, so that Python cannot store bytecode: Triton loads a version again when its folder has changed.
NO_BYTECODE = "__pycache__"

WARMUP_TASK = "warm up"


@dataclass(frozen=True)
class GeneratedModel:
    """A model's configuration and files, without its weights.

    model_file: content of model.py; None: an ensemble
    warmup_files: contents by name
    """

    config: pb.ModelConfig
    version: int
    model_file: bytes | None = None
    warmup_files: dict[str, bytes] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The model's name in the repository."""
        return str(self.config.name)

    @property
    def is_ensemble(self) -> bool:
        """True if the model consists of other models."""
        return self.model_file is None

    def files(self) -> dict[str, bytes]:
        """Return file contents by path in the repository."""
        in_version = {KEEP_FILE: b""} if self.model_file is None else {MODEL_FILE: self.model_file, NO_BYTECODE: b""}
        contents = {CONFIG_FILE: render(self.config).encode()}
        contents |= {f"{self.version}/{name}": content for name, content in in_version.items()}
        contents |= {f"{WARMUP_FOLDER}/{name}": content for name, content in self.warmup_files.items()}
        return {f"{self.name}/{path}": content for path, content in contents.items()}


@dataclass(frozen=True)
class Version:
    """Settings that all models in an exported version share.

    num_gpus: 0: the CPU
    family: package of the checkpoint's family
    """

    number: int
    settings: ExportConfig
    num_gpus: int
    family: str

    def checkpoint_folder(self, description: Description, repository: Path) -> Path:
        """Return the folder for the checkpoint's files."""
        return repository / scorer_name(description, self.settings.name) / str(self.number) / CHECKPOINT_FOLDER

    def encoders_folder(self, repository: Path) -> Path:
        """Return the folder for the encoders' files."""
        return repository / encoder_name(self.settings.name) / str(self.number)


def generated_files(models: Sequence[GeneratedModel], repository: Path) -> dict[str, bytes]:
    """Return contents of generated files by path, with digests of the weights in ``repository``."""
    for model in models:
        _record_digests(model.config, model.version, repository)
    return {path: content for model in models for path, content in model.files().items()}


def scorer_name(description: Description, name: str) -> str:
    """Return the name that the checkpoint's model gets in an export as ``name``."""
    return frames_name(name) if description.widths is None else name


def generated_models(description: Description, encoders: Description | None, version: Version) -> list[GeneratedModel]:
    """Return the models for a checkpoint and its encoders, parts before their ensemble."""
    name, widths, cache_mib = version.settings.name, description.widths, version.settings.feature_cache_mib
    # Two small networks keep a GPU busy: one scores while the other reads.
    several = widths is not None and version.num_gpus > 0
    settings = replace(version.settings, instances=version.settings.instances or (2 if several else 1))
    # With several instances on a device, each cache would have to see all frames.
    keeps = description.keeps_features and cache_mib > 0 and settings.instances == 1
    # A frame reference needs the cache that holds the frame, but Triton chooses the instance: so only one may exist.
    has_one_cache = cache_mib > 0 and version.num_gpus <= 1
    outputs = wire.score_outputs(description.progress_bins, description.more_scores)
    has_digests = keeps and has_one_cache
    inputs = wire.frame_inputs(by_digest=has_digests, with_views=description.reads_views)
    inputs = inputs if widths is None else wire.embedding_inputs(*widths)
    scorer = Interface(scorer_name(description, name), inputs, outputs, description)
    version = replace(version, settings=settings)
    models = [_python_model(scorer, "rfm", version, _warmups(description), keeps=keeps)]
    if settings.cuda_graphs:
        models[0].config.parameters[GRAPHS_PARAMETER].string_value = "true"
    if encoders is None or widths is None:
        return models
    encodes = replace(encoders, video_dim=widths[0], text_dim=widths[1])
    inputs = wire.encoder_inputs(by_digest=has_one_cache)
    encoder = Interface(encoder_name(name), inputs, wire.encoder_outputs(*widths), encodes)
    of_encoder = replace(version, settings=replace(settings, instances=1)) if cache_mib else version
    warmup = Warmup("frames", wire.encode_frames(blank_trajectory(None, task=WARMUP_TASK)))
    models.append(_python_model(encoder, "rfm_encoder", of_encoder, [warmup], keeps=True))
    with_frames = replace(description, video_dim=None, text_dim=None, frame_size=encoders.frame_size)
    frames = Interface(frames_name(name), wire.frame_inputs(by_digest=has_one_cache), outputs, with_frames)
    return [*models, GeneratedModel(ensemble_config(frames, settings, version.number, encoder, scorer), version.number)]


def _python_model(
    interface: Interface, template: str, version: Version, warmups: list[Warmup], *, keeps: bool
) -> GeneratedModel:
    """Build a Python model. keeps: True if the model keeps frame features"""
    model_file = resources.files("rfm_export") / "templates" / template / MODEL_FILE
    files = {name: content for warmup in warmups for name, content in warmup.files().items()}
    config = python_config(interface, version.settings, version.num_gpus, version.number, warmups)
    config.parameters[FAMILY_PARAMETER].string_value = version.family
    if keeps:
        config.parameters[FEATURE_CACHE_PARAMETER].string_value = str(version.settings.feature_cache_mib)
    return GeneratedModel(config, version.number, model_file.read_bytes(), files)


def _warmups(description: Description) -> list[Warmup]:
    """Return a sample per type that the checkpoint can score; none if scoring may fail."""
    if description.may_not_answer:
        return []
    trajectory = blank_trajectory(description.widths, task=WARMUP_TASK)
    samples: dict[str, Sample] = {"progress": ProgressSample(trajectory)}
    if description.has_preference:
        samples["preference"] = PreferenceSample(trajectory, trajectory)
    if description.has_similarity:
        samples["similarity"] = SimilaritySample(trajectory, trajectory)
    return [Warmup(name, wire.encode_samples([sample])) for name, sample in samples.items()]


def description_in(config: pb.ModelConfig) -> Description:
    """Return the description in an exported configuration. Raises ValueError."""
    return Description.parse(config.parameters[DESCRIPTION_PARAMETER].string_value)


def _record_digests(config: pb.ModelConfig, version: int, repository: Path) -> None:
    """Set the digests of a version's weights and settings in ``repository``; an ensemble gets its parts' digests."""
    parts = [step.model_name for step in config.ensemble_scheduling.step] or [config.name]
    folders = [repository / part / str(version) for part in parts]
    kinds = [pb.ModelInstanceGroup.Kind.Name(group.kind) for group in config.instance_group]
    settings = {"dtype": config.parameters[DTYPE_PARAMETER].string_value, "kinds": kinds} if kinds else {}
    found = replace(
        description_in(config),
        weights_digest=weights_digest(folders),
        settings_digest=settings_digest(folders, settings),
    )
    config.parameters[DESCRIPTION_PARAMETER].string_value = found.to_json()
