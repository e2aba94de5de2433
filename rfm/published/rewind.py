# SPDX-License-Identifier: MIT
"""ReWiND checkpoints: the network's weights and, under a prefix, the encoders'.

Where configuration and weights disagree, the weights decide.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rfm.config import CheckpointConfig
from rfm.families.rewind.checkpoint import MODEL_TYPE, RewindCheckpoint
from rfm.families.rewind.encoders import Encoders
from rfm.families.rewind.network import RewindConfig
from rfm.families.rewind.pretrained import IMAGE_MODELS, TEXT_MODELS, load_config, load_preprocessor
from rfm.files import (
    NETWORK_CONFIG,
    RUN_CONFIG,
    CheckpointError,
    cut,
    misfits,
    network_config,
    read_run_config,
    shown,
)
from rfm.published.provenance import UPSTREAM_DEFAULT, Assumption, source_name
from rfm.published.reader import Loaded, Reader
from rfm.published.run_config import MAX_COUNT, check_progress, find_run_config, frame_count, trained_frames
from rfm.published.weights import has_head, read_weights, take_prefix
from rfm_client.contract.checks import require

# Upstream's encoders, whose embeddings ReWiND checkpoints are trained on, and the settings in their files.
IMAGE_ENCODER = "facebook/dinov2-base"
TEXT_ENCODER = "sentence-transformers/all-MiniLM-L12-v2"
_SHAPE = {"num_hidden_layers": 12, "num_attention_heads": 12}
_IMAGE_SETTINGS: dict[str, Any] = {
    "model_type": "dinov2",
    "hidden_size": 768,
    "patch_size": 14,
    **_SHAPE,
    "resize_px": 256,
    "crop_px": (224, 224),
    "mean": (0.485, 0.456, 0.406),
    "std": (0.229, 0.224, 0.225),
}
_TEXT_SETTINGS: dict[str, Any] = {"model_type": "bert", "hidden_size": 384, "vocab_size": 30522, **_SHAPE}
IMAGE_ENCODER_PREFIX = "image_encoder."
TEXT_ENCODER_PREFIX = "text_encoder."
# Upstream's configurations from before causal_mask state all these fields; no network had a causal mask then.
_FIRST_FIELDS = ("video_feature_dim", "text_feature_dim", "hidden_dim", "num_layers", "num_attention_heads", "max_len")
# Upper size limits for a network, against files that would only cost memory and time; the lower limit is 1.
_LIMITS = dict.fromkeys((*_FIRST_FIELDS, "progress_bins"), MAX_COUNT) | {"num_layers": 1024}
_LAYERS = "transformer.layers."
_STATED_TYPES: dict[str, type] = {"num_attention_heads": int, "max_len": int, "causal_mask": bool}
# The paper's first code (https://github.com/Jiahui-3205/ReWiND_Release) predicts only progress, uses other names and
# has no configuration. Its networks all have 8 attention heads and a causal mask. Its training script shows 16 frames
# by default.
_FIRST_CODES_FRAME = "first_pos_embed"  # [1, D]; added to the first frame
_FIRST_CODES_UNREAD = "class_token"  # a parameter that the network never reads
_FIRST_CODES_SETTINGS = {"num_attention_heads": 8, "causal_mask": True, "max_len": 16}


def _loaded(
    checkpoint: RewindCheckpoint, assumed: tuple[Assumption, ...], named: tuple[str | None, str | None] = (None, None)
) -> Loaded:
    """Return the checkpoint with its encoders, if it has their weights or the user names them, which no file proves.

    named: folders or ids of image encoder and text encoder; None: upstream's
    """
    checkpoint.check()
    own = checkpoint.image_encoder, checkpoint.text_encoder
    if not any((*own, *named)):
        return Loaded(checkpoint, assumed)
    sources = named[0] or IMAGE_ENCODER, named[1] or TEXT_ENCODER
    of_encoders = []
    for kind, source, option, weights in zip(("image", "text"), sources, named, own, strict=True):
        given = f"--{kind}-encoder" if option else UPSTREAM_DEFAULT
        whose = "its settings alone: the weights are the checkpoint's" if weights else "only its width agrees"
        of_encoders.append(Assumption(f"{kind}_encoder", source_name(source), f"{given}; {whose}"))
    load = partial(_encoders, checkpoint, sources)
    return Loaded(checkpoint, (*assumed, *of_encoders), lambda _checkpoint: _encoder_notes(sources, own), load)


def _encoder_notes(sources: tuple[str, str], own: tuple[object, object]) -> list[str]:
    """Return one line per encoder that differs from upstream's with the same width. Raises CheckpointError."""
    with _having_encoders(sources, own):
        found = image_differences(sources[0]), text_differences(sources[1])
    return [
        f"{source}: differs from upstream's {known} in {'; '.join(lines)}: scores are right only if the run's "
        "embeddings were made with it"
        for known, source, lines in zip((IMAGE_ENCODER, TEXT_ENCODER), sources, found, strict=True)
        if lines
    ]


def image_differences(source: str) -> list[str]:
    """Return the differences between upstream's image encoder and another with its width, by their files."""
    return _differences(_IMAGE_SETTINGS, load_config(source, IMAGE_MODELS), load_preprocessor(source))


def text_differences(source: str) -> list[str]:
    """Return the differences between upstream's text encoder and another with its width, by their files."""
    return _differences(_TEXT_SETTINGS, load_config(source, TEXT_MODELS))


def _differences(known: Mapping[str, Any], *files: Any) -> list[str]:
    got = {name: next((getattr(file, name) for file in files if hasattr(file, name)), None) for name in known}
    if got["hidden_size"] != known["hidden_size"]:
        return []  # another encoder, as the weights' shapes tell
    return [f"{name}: expected {known[name]}, got {got[name]}" for name in known if got[name] != known[name]]


def _encoders(checkpoint: RewindCheckpoint, sources: tuple[str, str]) -> Encoders:
    """Load a checkpoint's encoders. Raises CheckpointError if they are missing or do not fit the network."""
    with _having_encoders(sources, (checkpoint.image_encoder, checkpoint.text_encoder)):
        encoders = Encoders.from_pretrained(
            *sources, image_weights=checkpoint.image_encoder or None, text_weights=checkpoint.text_encoder or None
        )
    widths, expected = (encoders.video_feature_dim, encoders.text_feature_dim), checkpoint.description.widths
    require(f"encoders {' and '.join(sources)}", widths == expected, f"widths {expected}", widths, CheckpointError)
    return encoders


@contextmanager
def _having_encoders(sources: tuple[str, str], own: tuple[object, object]) -> Iterator[None]:
    try:
        yield
    except misfits(ImportError, OSError, CheckpointError) as error:
        absent = [source for source in sources if not Path(source).is_dir()]
        here = f"; there is no folder {' nor '.join(absent)} either" if absent else ""
        hint = f"name local folders with --image-encoder and --text-encoder{here}"
        need = ", whose settings the checkpoint's encoder weights need" if any(own) else ""
        what = f"encoders {' and '.join(sources)}{need}"
        raise CheckpointError(f"{what}: {cut(str(error))} ({hint})") from error


def reads(folder: Path) -> bool:
    """True unless config.json names another network; the first ReWiND checkpoints have no config.json."""
    return network_config(folder).get("model_type", MODEL_TYPE) == MODEL_TYPE


def load(folder: Path, options: CheckpointConfig) -> Loaded:
    """Load a checkpoint from a local folder. Raises CheckpointError."""
    network = read_weights(folder)
    if _FIRST_CODES_FRAME in network:
        return _of_first_code(folder, network, options)
    image_encoder = take_prefix(network, IMAGE_ENCODER_PREFIX)
    text_encoder = take_prefix(network, TEXT_ENCODER_PREFIX)
    stated, assumed = _stated(folder)
    config = _config(folder, network, stated)
    if not config.has_preference:  # upstream's networks have these weights even without the heads that use them
        network.pop("preference_token", None)
    if not config.has_pairs:
        network.pop("first_embedding_B", None)
    checkpoint = RewindCheckpoint(config, network, image_encoder, text_encoder)
    return _loaded(checkpoint, assumed, (options.image_encoder, options.text_encoder))


def _of_first_code(folder: Path, weights: dict[str, Tensor], options: CheckpointConfig) -> Loaded:
    """Return the checkpoint, with its weights renamed to upstream's names."""
    first = weights.pop(_FIRST_CODES_FRAME)
    require(_FIRST_CODES_FRAME, first.dim() == 2, "2 axes", list(first.shape), CheckpointError)
    weights.pop(_FIRST_CODES_UNREAD, None)
    weights["first_embedding_A"] = first[None]
    if options.image_encoder or options.text_encoder:
        raise CheckpointError(
            f"{folder}: encoders: expected none for a checkpoint of the first ReWiND code, which crops frames and does "
            "not resize them; encode frames as it does, and send video_embeddings and text_embedding"
        )
    read, unproven = _stated(folder)
    read = {name: value for name, value in read.items() if name not in {each.name for each in unproven}}
    stated = {**_FIRST_CODES_SETTINGS, **read}
    config = _config(folder, weights, {**stated, "trained_frames": stated["max_len"]})
    defaults = {name: value for name, value in _FIRST_CODES_SETTINGS.items() if name not in read}
    assumed = (Assumption(name, value, "default of the first ReWiND code") for name, value in defaults.items())
    return _loaded(RewindCheckpoint(config, weights), tuple(assumed))


def _config(folder: Path, weights: Mapping[str, Tensor], stated: Mapping[str, Any]) -> RewindConfig:
    def required(name: str) -> Any:
        if name not in stated:
            places = f"{NETWORK_CONFIG} or model.rewind of {RUN_CONFIG}"
            got = "got it in neither; weights do not tell it"
            raise CheckpointError(f"{folder}: {name}: expected it in {places}, {got}")
        return stated[name]

    has_progress_tokens = "prog_token_A" in weights
    try:
        max_len = _shape(weights, "prog_token_A", 3)[1] if has_progress_tokens else required("max_len")
        hidden_dim, video_feature_dim = _shape(weights, "video_proj.weight", 2)
        config = RewindConfig(
            video_feature_dim=video_feature_dim,
            text_feature_dim=_shape(weights, "text_proj.weight", 2)[1],
            hidden_dim=hidden_dim,
            num_layers=len({name.split(".")[2] for name in weights if name.startswith(_LAYERS)}),
            num_attention_heads=required("num_attention_heads"),
            max_len=max_len,
            causal_mask=required("causal_mask"),
            use_per_frame_progress_token=has_progress_tokens,
            progress_bins=_shape(weights, "progress_head.4.weight", 2)[0],
            has_similarity="similarity_head.0.weight" in weights,
            trained_frames=stated["trained_frames"],
            trained_padding=stated["trained_padding"],
            has_preference=has_head(weights, "preference"),
            has_success=has_head(weights, "success"),
        )
    except KeyError as error:
        raise CheckpointError(f"{folder}: expected a ReWiND checkpoint, which has {error}") from error
    for name, most in _LIMITS.items():
        if not 1 <= getattr(config, name) <= most:
            raise CheckpointError.at(f"{folder}: {name}", f"1 to {most}", shown(getattr(config, name)))
    if config.hidden_dim % config.num_attention_heads:
        heads = f"a divisor of the hidden width {config.hidden_dim}"
        raise CheckpointError.at(f"{folder}: num_attention_heads", heads, config.num_attention_heads)
    return config


def _shape(weights: Mapping[str, Tensor], name: str, rank: int) -> torch.Size:
    """Return a weight's shape. Raises KeyError if it is missing, CheckpointError unless it has ``rank`` axes."""
    shape = weights[name].shape
    require(name, len(shape) == rank, f"{rank} axes", list(shape), CheckpointError)
    return shape


def _stated(folder: Path) -> tuple[dict[str, Any], tuple[Assumption, ...]]:
    """Return the network's settings from config.json and config.yaml, and the settings that neither proves.

    Raises CheckpointError if the files disagree.
    """
    saved, run, run_file = network_config(folder), {}, find_run_config(folder)
    network: Any = {}
    if run_file is not None:
        run = read_run_config(run_file)
        check_progress(run, run_file)
        model = run.get("model") or {}
        network = model.get("rewind") or {} if isinstance(model, dict) else model
        if not isinstance(network, dict):
            raise CheckpointError.at(f"{run_file}: model.rewind", "a mapping", shown(network))
    if saved.get("model_type", MODEL_TYPE) != MODEL_TYPE:
        got = cut(str(saved["model_type"]))
        raise CheckpointError.at(f"{folder / NETWORK_CONFIG}: model_type", MODEL_TYPE, got)
    stated: dict[str, Any] = {}
    sources = {NETWORK_CONFIG: saved, RUN_CONFIG: network}
    for name, kind in _STATED_TYPES.items():
        values = {source: content[name] for source, content in sources.items() if content.get(name) is not None}
        for source, value in values.items():
            if type(value) is not kind:
                raise CheckpointError.at(f"{folder}: {name} in {source}", kind.__name__, shown(value))
        if name != "max_len" and len(set(values.values())) > 1:  # where max_len matters, the weights show it
            raise CheckpointError.at(f"{folder}: {name}", f"{' and '.join(values)} to agree", values)
        if values:
            stated[name] = next(iter(values.values()))
    assumed: tuple[Assumption, ...] = ()
    if "causal_mask" not in stated and any(content.keys() >= {*_FIRST_FIELDS} for content in sources.values()):
        stated["causal_mask"] = False
        assumed = (Assumption("causal_mask", False, f"{UPSTREAM_DEFAULT} of before causal_mask"),)
    # ``save`` wrote these into config.json; otherwise the run's file has them.
    frames = frame_count(saved.get("trained_frames"), f"{folder / NETWORK_CONFIG}: trained_frames")
    if frames is None and run_file is not None:
        frames = trained_frames(run, run_file)
    padding = saved.get("trained_padding")
    if padding is not None and not isinstance(padding, bool):
        where = f"{folder / NETWORK_CONFIG}: trained_padding"
        raise CheckpointError.at(where, "true or false", shown(padding))
    return {**stated, "trained_frames": frames, "trained_padding": padding}, assumed


READER = Reader(reads, load)
