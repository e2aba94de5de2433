# SPDX-License-Identifier: MIT
"""ReWiND checkpoints: one flat file of weights, the encoders' under a prefix.

Where configuration and weights disagree, the weights decide.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from rfm.checkpoint.content import CheckpointError, cut, is_there, misfits, read_json, read_run_config, shown
from rfm.checkpoint.decision import (
    OF_UPSTREAM,
    OF_WEIGHTS,
    TRAINED_WITH_PADDING,
    Decision,
    file_name,
    source_name,
)
from rfm.checkpoint.files import (
    MAX_COUNT,
    NETWORK_CONFIG,
    RUN_CONFIG,
    WEIGHTS,
    check_shapes,
    find_run_config,
    frame_count,
    has_head,
    read_weights,
    take_prefix,
    trained_frames,
)
from rfm.checkpoint.training import check_progress
from rfm.family import NETWORK, Description, Options, config_fields
from rfm.feature_cache import FeatureCache
from rfm.rewind import first_code, usual
from rfm.rewind.encoders import Encoders
from rfm.rewind.network import RewindConfig, RewindTransformer
from rfm.rewind.predictor import RewindPredictor

MODEL_TYPE = "rewind_transformer"
IMAGE_ENCODER_PREFIX = "image_encoder."
TEXT_ENCODER_PREFIX = "text_encoder."

# Upstream's configurations of before causal_mask, when no network had one, state all of these.
_FIRST_FIELDS = {"video_feature_dim", "text_feature_dim", "hidden_dim", "num_layers", "num_attention_heads", "max_len"}
# What no ReWiND network is beyond, nor below 1: whatever is larger is a lie that would only cost memory and time.
_LIMITS = {
    "video_feature_dim": MAX_COUNT,
    "text_feature_dim": MAX_COUNT,
    "hidden_dim": MAX_COUNT,
    "num_layers": 1024,
    "num_attention_heads": MAX_COUNT,
    "max_len": MAX_COUNT,
    "progress_bins": MAX_COUNT,
}
_LAYERS = "transformer.layers."
_OF_WEIGHTS = (
    "video_feature_dim", "text_feature_dim", "hidden_dim", "num_layers", "use_per_frame_progress_token",
    "progress_bins", "has_similarity", "has_preference", "has_success",
)  # fmt: skip
_STATED_TYPES: dict[str, type] = {"num_attention_heads": int, "max_len": int, "causal_mask": bool}


@dataclass(frozen=True)
class RewindCheckpoint:
    """A ReWiND checkpoint in memory.

    network: weights of RewindTransformer
    image_encoder, text_encoder: encoder weights without their prefix; empty if the checkpoint has none
    image_source, text_source: folders or ids of the encoders that the user names; None: the usual ones, if the
        checkpoint has weights of encoders
    settings: what decided its configuration
    """

    config: RewindConfig
    network: dict[str, Tensor]
    image_encoder: dict[str, Tensor] = field(default_factory=dict)
    text_encoder: dict[str, Tensor] = field(default_factory=dict)
    image_source: str | None = None
    text_source: str | None = None
    settings: tuple[Decision, ...] = ()

    @property
    def description(self) -> Description:
        """What the checkpoint takes, and what it answers."""
        return Description(
            network_class=RewindTransformer.__name__,
            widths=(self.config.video_feature_dim, self.config.text_feature_dim),
            progress_bins=self.config.progress_bins,
            has_similarity=self.config.has_similarity,
            max_frames=self.config.max_frames,
            trained_frames=self.config.trained_frames,
            trained_padding=self.config.trained_padding,
            has_preference=self.config.has_preference,
            has_success=self.config.has_success,
        )

    @property
    def parts(self) -> dict[str, dict[str, Tensor]]:
        """All weights, by part and name."""
        return {NETWORK: self.network, "image_encoder": self.image_encoder, "text_encoder": self.text_encoder}

    @property
    def notes(self) -> list[str]:
        """A line on each encoder that is as wide as upstream's and another one."""
        if not self._has_encoders:
            return []
        sources = (usual.IMAGE_ENCODER, self._image_source), (usual.TEXT_ENCODER, self._text_source)
        found = [usual.differences(facts) for facts in self._facts()]
        return [
            f"{source}: differs from upstream's {known} in {'; '.join(names)}: scores are right only if the run's "
            "embeddings were made with it"
            for (known, source), names in zip(sources, found, strict=True)
            if names
        ]

    def decisions(self) -> list[Decision]:
        """What decided each setting, and the encoders, which no file of a training run names."""
        if not self._has_encoders:
            return [*self.settings]
        taken = (
            ("image_encoder", self._image_source, self.image_source, self.image_encoder),
            ("text_encoder", self._text_source, self.text_source, self.text_encoder),
        )
        decided = [*self.settings]
        for (name, source, named, weights), facts in zip(taken, self._facts(), strict=True):
            option = f"--{name.replace('_', '-')}" if named else OF_UPSTREAM
            whose = "weights of the checkpoint" if weights else "only its width agrees"
            decided.append(Decision(name, source_name(source), f"{option}; {whose}", is_assumed=True))
            decided.append(Decision(f"{name}_settings", facts, f"files of {source_name(source)}"))
        return decided

    def _facts(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """What the files of the image encoder and of the text encoder say. Raises CheckpointError."""
        with self._having_encoders():
            return usual.image_facts(self._image_source), usual.text_facts(self._text_source)

    @property
    def _has_encoders(self) -> bool:
        return any((self.image_encoder, self.text_encoder, self.image_source, self.text_source))

    @property
    def _image_source(self) -> str:
        return self.image_source or usual.IMAGE_ENCODER

    @property
    def _text_source(self) -> str:
        return self.text_source or usual.TEXT_ENCODER

    def encoders(self) -> Encoders | None:
        """The encoders of a checkpoint that has them, or for which the user names them; else None.

        Raises CheckpointError if they cannot be had or do not fit the network.
        """
        if not self._has_encoders:
            return None
        with self._having_encoders():
            encoders = Encoders.from_pretrained(
                self._image_source,
                self._text_source,
                image_weights=self.image_encoder or None,
                text_weights=self.text_encoder or None,
            )
        widths, expected = (encoders.video_feature_dim, encoders.text_feature_dim), self.description.widths
        if widths != expected:
            where = f"encoders {self._image_source} and {self._text_source}"
            raise CheckpointError(f"{where}: expected widths {expected}, got {widths}")
        return encoders

    @contextmanager
    def _having_encoders(self) -> Iterator[None]:
        """Turns what is raised of encoders that cannot be had into a CheckpointError."""
        sources = (self._image_source, self._text_source)
        try:
            yield
        except misfits(ImportError, OSError) as error:
            absent = [source for source in sources if not Path(source).is_dir()]
            here = f"; there is no folder {' nor '.join(absent)} either" if absent else ""
            hint = f"name local folders with --image-encoder and --text-encoder{here}"
            raise CheckpointError(f"encoders {' and '.join(sources)}: {cut(str(error))} ({hint})") from error

    def predictor(
        self, device: torch.device, dtype: torch.dtype | None = None, cache: FeatureCache[Any] | None = None
    ) -> RewindPredictor:
        """The network on ``device``. Raises CheckpointError.

        dtype: of the network; None: float32
        cache: of no use: it reads embeddings
        """
        return RewindPredictor(self.build(), device, dtype or torch.float32)

    def save(self, folder: Path) -> None:
        """Writes network and configuration in the layout that ``load`` reads, without encoders."""
        folder.mkdir(parents=True)
        config = {"model_type": MODEL_TYPE, **config_fields(self.config)}
        (folder / NETWORK_CONFIG).write_text(json.dumps(config, indent=2) + "\n")
        tensors = {name: tensor.contiguous() for name, tensor in self.network.items()}
        save_file(tensors, folder / WEIGHTS, metadata={"format": "pt"})

    def build(self) -> RewindTransformer:
        """The network with these weights, on the CPU, ready to score. Raises CheckpointError."""
        self.check()
        network = RewindTransformer(self.config)
        network.load_state_dict(self.network, strict=True)
        return network.eval().requires_grad_(False)

    def check(self) -> None:
        """Raises CheckpointError unless the weights are those of the network; no memory is taken for it before."""
        with torch.device("meta"):
            network = RewindTransformer(self.config)
        check_shapes(network.state_dict(), self.network)


def reads(folder: Path) -> bool:
    """Whether the folder does not say that it holds something else; the first ReWiND checkpoints say nothing."""
    config = folder / NETWORK_CONFIG
    return not is_there(config) or read_json(config).get("model_type", MODEL_TYPE) == MODEL_TYPE


def load(folder: Path, options: Options) -> RewindCheckpoint:
    """The checkpoint in a local folder. Raises CheckpointError."""
    network = read_weights(folder)
    if (renamed := first_code.renamed(network)) is not None:
        return _of_first_code(folder, renamed, options)
    image_encoder = take_prefix(network, IMAGE_ENCODER_PREFIX)
    text_encoder = take_prefix(network, TEXT_ENCODER_PREFIX)
    sources = options.image_encoder, options.text_encoder
    stated = {**_stated(folder), "trained_frames": _trained_frames(folder)}
    config = _rewind_config(folder, network, stated)
    for name in _unread(config):
        network.pop(name, None)
    checkpoint = RewindCheckpoint(config, network, image_encoder, text_encoder, *sources, _settings(config, stated))
    checkpoint.check()
    return checkpoint


def _of_first_code(folder: Path, weights: dict[str, Tensor], options: Options) -> RewindCheckpoint:
    if options.image_encoder or options.text_encoder:
        raise CheckpointError(
            f"{folder}: encoders: expected none for a checkpoint of the first ReWiND code, which crops frames and does "
            "not resize them; encode frames as it does, and send video_embeddings and text_embedding"
        )
    read = {name: decision for name, decision in _stated(folder).items() if not decision.is_assumed}
    stated = {**first_code.SETTINGS, **read}
    stated["trained_frames"] = Decision("trained_frames", stated["max_len"].value, "max_len")
    config = _rewind_config(folder, weights, stated)
    checkpoint = RewindCheckpoint(config, weights, settings=_settings(config, stated))
    checkpoint.check()
    return checkpoint


def _settings(config: RewindConfig, stated: Mapping[str, Decision]) -> tuple[Decision, ...]:
    """What decided each setting of the network, and the clients' defaults."""
    of_weights = (*_OF_WEIGHTS, *(["max_len"] if config.use_per_frame_progress_token else []))
    padding = Decision("trained_padding", config.trained_padding, NETWORK_CONFIG)
    return (
        *(Decision(name, getattr(config, name), OF_WEIGHTS) for name in of_weights),
        *(decision for name, decision in stated.items() if name not in of_weights),
        TRAINED_WITH_PADDING if config.trained_padding is None else padding,
    )


def _unread(config: RewindConfig) -> list[str]:
    """Weights that upstream's network has, and that are read for the sake of heads alone that this one lacks."""
    return [
        *([] if config.has_preference else ["preference_token"]),
        *([] if config.has_pairs else ["first_embedding_B"]),
    ]


def _rewind_config(folder: Path, weights: Mapping[str, Tensor], stated: Mapping[str, Decision]) -> RewindConfig:
    has_progress_tokens = "prog_token_A" in weights
    try:
        max_len = _shape(weights, "prog_token_A", 3)[1] if has_progress_tokens else _required(stated, "max_len", folder)
        hidden_dim, video_feature_dim = _shape(weights, "video_proj.weight", 2)
        config = RewindConfig(
            video_feature_dim=video_feature_dim,
            text_feature_dim=_shape(weights, "text_proj.weight", 2)[1],
            hidden_dim=hidden_dim,
            num_layers=len({name.split(".")[2] for name in weights if name.startswith(_LAYERS)}),
            num_attention_heads=_required(stated, "num_attention_heads", folder),
            max_len=max_len,
            causal_mask=_required(stated, "causal_mask", folder),
            use_per_frame_progress_token=has_progress_tokens,
            progress_bins=_shape(weights, "progress_head.4.weight", 2)[0],
            has_similarity="similarity_head.0.weight" in weights,
            trained_frames=stated["trained_frames"].value,
            trained_padding=_trained_padding(folder),
            has_preference=has_head(weights, "preference"),
            has_success=has_head(weights, "success"),
        )
    except KeyError as error:
        raise CheckpointError(f"{folder}: expected a ReWiND checkpoint, which has {error}") from error
    for name, most in _LIMITS.items():
        if not 1 <= getattr(config, name) <= most:
            raise CheckpointError(f"{folder}: {name}: expected 1 to {most}, got {shown(getattr(config, name))}")
    if config.hidden_dim % config.num_attention_heads:
        heads = f"a divisor of the hidden width {config.hidden_dim}"
        raise CheckpointError(f"{folder}: num_attention_heads: expected {heads}, got {config.num_attention_heads}")
    return config


def _required(stated: Mapping[str, Decision], name: str, folder: Path) -> Any:
    """Raises CheckpointError for a value that neither weights nor configurations hold."""
    if name not in stated:
        places = f"{NETWORK_CONFIG} or model.rewind of {RUN_CONFIG}"
        raise CheckpointError(f"{folder}: {name}: expected it in {places}, got it in neither; weights do not tell it")
    return stated[name].value


def _shape(weights: Mapping[str, Tensor], name: str, rank: int) -> torch.Size:
    """Raises KeyError if there is no such weight, CheckpointError if it has another number of axes."""
    shape = weights[name].shape
    if len(shape) != rank:
        raise CheckpointError(f"{name}: expected {rank} axes, got {list(shape)}")
    return shape


def _trained_frames(folder: Path) -> Decision:
    """The most frames of a trajectory in training, as ``save`` wrote it to config.json, else as config.yaml has it."""
    if is_there(folder / NETWORK_CONFIG):
        saved = read_json(folder / NETWORK_CONFIG).get("trained_frames")
        if saved is not None:
            frames = frame_count(saved, f"{folder / NETWORK_CONFIG}: trained_frames")
            return Decision("trained_frames", frames, NETWORK_CONFIG)
    file = find_run_config(folder)
    if file is None:
        return Decision("trained_frames", None, "no file says it")
    source = f"{file_name(file, folder)}: data.max_frames"
    return Decision("trained_frames", trained_frames(read_run_config(file), file), source)


def _trained_padding(folder: Path) -> bool | None:
    """Whether training padded shorter trajectories, as ``save`` wrote it; upstream's configurations do not say."""
    file = folder / NETWORK_CONFIG
    padding = read_json(file).get("trained_padding") if is_there(file) else None
    if padding is not None and not isinstance(padding, bool):
        raise CheckpointError(f"{file}: trained_padding: expected true or false, got {shown(padding)}")
    return padding


def _stated(folder: Path) -> dict[str, Decision]:
    """What config.json and config.yaml say of the network. Both may lack a field; neither may contradict the other."""
    sources: dict[str, dict[str, Any]] = {}
    places = {NETWORK_CONFIG: NETWORK_CONFIG}
    if is_there(folder / NETWORK_CONFIG):
        sources[NETWORK_CONFIG] = read_json(folder / NETWORK_CONFIG)
    run_config = find_run_config(folder)
    if run_config is not None:
        run = read_run_config(run_config)
        check_progress(run, run_config)
        model = run.get("model") or {}
        network = model.get("rewind") or {} if isinstance(model, dict) else model
        if not isinstance(network, dict):
            raise CheckpointError(f"{run_config}: model.rewind: expected a mapping, got {shown(network)}")
        sources[RUN_CONFIG] = network
        places[RUN_CONFIG] = f"{file_name(run_config, folder)}: model.rewind"
    model_type = sources.get(NETWORK_CONFIG, {}).get("model_type", MODEL_TYPE)
    if model_type != MODEL_TYPE:
        raise CheckpointError(
            f"{folder / NETWORK_CONFIG}: model_type: expected {MODEL_TYPE}, got {cut(str(model_type))}"
        )
    stated: dict[str, Decision] = {}
    for name, kind in _STATED_TYPES.items():
        values = {source: content[name] for source, content in sources.items() if content.get(name) is not None}
        for source, value in values.items():
            if type(value) is not kind:
                raise CheckpointError(f"{folder}: {name} in {source}: expected {kind.__name__}, got {shown(value)}")
        if name != "max_len" and len(set(values.values())) > 1:  # weights show max_len where it matters
            raise CheckpointError(f"{folder}: {name}: expected {' and '.join(values)} to agree, got {values}")
        if values:
            stated[name] = Decision(name, next(iter(values.values())), " and ".join(places[each] for each in values))
    if any(content.keys() >= _FIRST_FIELDS for content in sources.values()):
        older = Decision("causal_mask", False, f"{OF_UPSTREAM} of before causal_mask", is_assumed=True)
        stated.setdefault("causal_mask", older)
    return stated
