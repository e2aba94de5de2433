# SPDX-License-Identifier: MIT
"""The models that serve a checkpoint, and every generated file of them.

Of a checkpoint that scores embeddings ``<name>`` does so; with encoders there are also ``<name>_encoder`` and
``<name>_frames``, the ensemble of the two, which scores raw frames. A checkpoint that scores raw frames itself is
``<name>_frames`` alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import resources

from tritonclient.grpc import model_config_pb2 as pb

from rfm.config import ExportConfig
from rfm.family import Description, EncodersDescription
from rfm.launch.repository_folder import CONFIG_FILE
from rfm.parameters import FAMILY_PARAMETER, FEATURE_CACHE_PARAMETER
from rfm_client.contract import FrameSize, PreferenceSample, ProgressSample, Sample, SimilaritySample, wire
from rfm_client.contract.made_up import blank_trajectory
from rfm_client.contract.model_info import (
    FRAME_SIZE_PARAMETER,
    FRAMES_PER_VALUE_PARAMETER,
    MAX_FRAMES_PARAMETER,
    TRAINED_PADDING_PARAMETER,
)
from rfm_client.contract.names import encoder_name, frames_name
from rfm_export.about import about_encoders
from rfm_export.pbtxt import Interface, Warmup, ensemble_config, exported_settings, python_config, render

MODEL_FILE = "model.py"
WARMUP_FOLDER = "warmup"
KEEP_FILE = ".keep"  # Triton wants an ensemble's version folder, and git forgets empty ones

WARMUP_TASK = "warm up"


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
        """The model's name in the repository."""
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


@dataclass(frozen=True)
class Version:
    """What the models of one exported version have in common.

    num_gpus: 0: the CPU
    family: package of the checkpoint's family
    about: parameters that name the checkpoint
    """

    number: int
    settings: ExportConfig
    num_gpus: int
    family: str
    about: Mapping[str, str]


def scorer_name(description: Description, name: str) -> str:
    """Name of the model that has the checkpoint, of those that are served as ``name``."""
    return frames_name(name) if description.widths is None else name


def generated_models(
    description: Description, encoders: EncodersDescription | None, version: Version
) -> list[GeneratedModel]:
    """The models of a checkpoint and its encoders, if it has some; an ensemble stands behind what it is made of."""
    version = replace(version, settings=_with_instances(description, version))
    name, widths = version.settings.name, description.widths
    outputs = wire.score_outputs(description.progress_bins if description.progress_bins > 1 else None)
    cache_mb = version.settings.feature_cache_mb
    keeps = description.keeps_features and _scorer_has_cache(version.settings)
    inputs = wire.frame_inputs(by_digest=keeps) if widths is None else wire.embedding_inputs(*widths)
    about = {**_limits(description, description.frame_size), **version.about}
    scorer = Interface(scorer_name(description, name), inputs, outputs, about)
    models = [_python_model(scorer, "rfm", version, _warmups(description))]
    if keeps:
        models[0].config.parameters[FEATURE_CACHE_PARAMETER].string_value = str(cache_mb)
    if encoders is None or widths is None:
        return models
    about = about_encoders(encoders, version.about)
    inputs = wire.encoder_inputs(by_digest=cache_mb > 0)
    encoder = Interface(encoder_name(name), inputs, wire.encoder_outputs(*widths), about)
    about = {**_limits(description, encoders.frame_size), **version.about}
    frames = Interface(frames_name(name), wire.frame_inputs(by_digest=cache_mb > 0), outputs, about)
    of_encoder = replace(version, settings=_of_encoder(version.settings))
    models.append(_python_model(encoder, "rfm_encoder", of_encoder, [_encoder_warmup()]))
    models[-1].config.parameters[FEATURE_CACHE_PARAMETER].string_value = str(cache_mb)
    models.append(
        GeneratedModel(ensemble_config(frames, version.settings, version.number, encoder, scorer), version.number)
    )
    return models


def _with_instances(description: Description, version: Version) -> ExportConfig:
    """The settings with a number of instances. Two small networks keep a GPU busy: one scores while the other reads."""
    several = description.widths is not None and version.num_gpus > 0
    return replace(version.settings, instances=version.settings.instances or (2 if several else 1))


def lay_out(config: pb.ModelConfig, **changed: int) -> None:
    """Makes of an exported model's configuration what an export with other settings would write.

    changed: ``instances``, ``torch_threads``, ``max_batch_size`` of ExportConfig

    A scorer that was exported without a feature cache gets none: its configuration does not tell whether it could have
    one.
    """
    told, cache = exported_settings(config), FEATURE_CACHE_PARAMETER in config.parameters
    cache_mb = int(config.parameters[FEATURE_CACHE_PARAMETER].string_value) if cache else 0
    settings = ExportConfig(**{**told, "feature_cache_mb": cache_mb, **changed})
    config.max_batch_size = settings.max_batch_size
    if not config.instance_group:  # an ensemble
        return
    if any(output.name == wire.VIDEO_EMBEDDINGS for output in config.output):
        settings = _of_encoder(settings)
    elif cache and not _scorer_has_cache(settings):
        del config.parameters[FEATURE_CACHE_PARAMETER]
        kept = [tensor for tensor in config.input if tensor.name != wire.FRAME_DIGESTS]
        del config.input[:]
        config.input.extend(kept)
    num_gpus = len(config.instance_group[0].gpus)
    new = python_config(Interface(config.name, (), ()), settings, num_gpus, version=0, warmups=[])
    config.instance_group[0].CopyFrom(new.instance_group[0])
    config.dynamic_batching.CopyFrom(new.dynamic_batching)
    for name, parameter in new.parameters.items():
        config.parameters[name].CopyFrom(parameter)


def _scorer_has_cache(settings: ExportConfig) -> bool:
    """Whether a scorer that can keep features does: several instances would each have to see all frames."""
    return settings.feature_cache_mb > 0 and settings.instances == 1


def _of_encoder(settings: ExportConfig) -> ExportConfig:
    """As the encoder is served: with a cache by one instance on each device, or each would have to see all frames."""
    return replace(settings, instances=1) if settings.feature_cache_mb else settings


def _limits(description: Description, frame_size: FrameSize | None) -> dict[str, str]:
    """What a client may want to know before it sends a trajectory; empty: no limit."""
    limits = [n for n in (description.trained_frames, description.max_frames) if n is not None]
    padding = description.trained_padding
    return {
        MAX_FRAMES_PARAMETER: str(min(limits)) if limits else "",
        FRAME_SIZE_PARAMETER: "" if frame_size is None else str(frame_size),
        FRAMES_PER_VALUE_PARAMETER: str(description.frames_per_value),
        **({} if padding is None else {TRAINED_PADDING_PARAMETER: str(padding).lower()}),
    }


def _python_model(interface: Interface, template: str, version: Version, warmups: list[Warmup]) -> GeneratedModel:
    model_file = resources.files("rfm_export") / "templates" / template / MODEL_FILE
    files = {name: content for warmup in warmups for name, content in warmup.files().items()}
    config = python_config(interface, version.settings, version.num_gpus, version.number, warmups)
    config.parameters[FAMILY_PARAMETER].string_value = version.family
    return GeneratedModel(config, version.number, model_file.read_bytes(), files)


def _warmups(description: Description) -> list[Warmup]:
    """One sample of each type that the checkpoint can score."""
    trajectory = blank_trajectory(description.widths, task=WARMUP_TASK)
    samples: dict[str, Sample] = {"progress": ProgressSample(trajectory)}
    if description.has_preference:
        samples["preference"] = PreferenceSample(trajectory, trajectory)
    if description.has_similarity:
        samples["similarity"] = SimilaritySample(trajectory, trajectory)
    return [Warmup(name, wire.encode_samples([sample])) for name, sample in samples.items()]


def _encoder_warmup() -> Warmup:
    return Warmup("frames", wire.encode_frames(blank_trajectory(None, task=WARMUP_TASK)))
