# SPDX-License-Identifier: MIT
"""Read RynnValue as it was published: its settings, in config.json and processor_config.json, and its weights."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

from rfm.config import CheckpointConfig
from rfm.families.rynnvalue.checkpoint import RynnCheckpoint
from rfm.families.rynnvalue.network import ACTIVATIONS, Bins, HeadConfig, RynnConfig, Transform
from rfm.families.rynnvalue.prompts import META, RELATIVE_TOKEN, VALUE_TOKEN
from rfm.files import NETWORK_CONFIG, CheckpointError, is_there, network_config, read_json, shown
from rfm.published.language import dtype_of, reopened
from rfm.published.provenance import Assumption, source_name
from rfm.published.qwen import QWEN_NAMES, UNUSED, backbone_config, renamed
from rfm.published.reader import Loaded, Reader
from rfm.published.rounding import kind_of, read_published, read_unrounded_config
from rfm.qwen.language import EMBEDDING
from rfm.qwen.network import QWEN3
from rfm.qwen.processor import PROCESSOR_CONFIG, pixel_limits, read_processor
from rfm.saved import is_saved, reward_model_of

ISOLATED = "pred_slot_isolated_eager"
_CAUSAL = ("eager", "sdpa", "flash_attention_2", "flash_attention_3", "flex_attention")
_STYLE = "interleaved_history"
# Facts from the published checkpoints, for keys that a file lacks.
_HEAD = {"head_type": "bro", "hidden_dims": 4096, "depth": 8, "activation": "relu"}
_BINS = {"bins": 256, "support_transform": "symlog", "bin_edges": None}
PUBLISHED: dict[str, Any] = {
    "attn_implementation": ISOLATED,
    "num_value_heads": 1,
    "value_token_repeat": 8,
    "relative_value_token_repeat": 8,
    "value_head_config": _HEAD,
    "relative_value_head_config": _HEAD,
    "value_tokenizer_config": {**_BINS, "min_value": 0.0, "max_value": 512.0},
    "relative_value_tokenizer_config": {**_BINS, "min_value": -256.0, "max_value": 256.0},
    "use_meta": True,
}
# Keys without effect on scores: for transformers, for training, and for the remote code.
_IDLE = {
    "_name_or_path", "architectures", "auto_map", "bos_token_id", "dtype", "encoding", "eos_token_id",
    "hl_gauss_sigma_ratio", "bin_edges_path", "initializer_range", "model_type", "pad_token_id", "processor_class",
    "torch_dtype", "transformers_version", "use_cache",
}  # fmt: skip
_BACKBONE_KEYS = {
    "image_token_id", "text_config", "tie_word_embeddings", "video_token_id", "vision_config", "vision_end_token_id",
    "vision_start_token_id", "quantization_config",
}  # fmt: skip
_TOKEN_KEYS = {"value_token_id", "relative_value_token_id"}
_COPY = "copy the file as it was published"


@dataclass
class Settings:
    """What a checkpoint's files say, and what they lack.

    unexpected: keys that are read nowhere
    """

    folder: Path
    content: Mapping[str, Any]
    processor: Mapping[str, Any]
    assumptions: list[Assumption] = field(default_factory=list)
    unexpected: list[str] = field(default_factory=list)

    @classmethod
    def read(cls, folder: Path, content: Mapping[str, Any]) -> Settings:
        """Return the settings from a folder with this config.json. Raises CheckpointError."""
        file = folder / PROCESSOR_CONFIG
        settings = cls(folder, content, read_json(file) if is_there(file) else {})
        known = PUBLISHED.keys() | _IDLE | _BACKBONE_KEYS | _TOKEN_KEYS
        settings._tell_unknown(NETWORK_CONFIG, content, known)
        settings._check_style()
        return settings

    def fields(self) -> dict[str, Any]:
        """Return the fields of RynnConfig that these files decide. Raises CheckpointError."""
        attention = self._one_of("attn_implementation", self._value("attn_implementation"), (ISOLATED, *_CAUSAL))
        return {
            "attention": "isolated" if attention == ISOLATED else "causal",
            "num_heads": self._whole("num_value_heads", self._value("num_value_heads")),
            "value_copies": self._copies("value_token_repeat"),
            "relative_copies": self._copies("relative_value_token_repeat"),
            "value_head": self._head("value_head_config"),
            "relative_head": self._head("relative_value_head_config"),
            "value_bins": self._bins("value_tokenizer_config"),
            "relative_bins": self._bins("relative_value_tokenizer_config"),
            "use_meta": self._use_meta(),
        }

    def token(self, key: str, token: str, tokenizer: Any) -> int:
        """Return a token's id, on which config.json and tokenizer agree. Raises CheckpointError."""
        known = tokenizer.get_vocab().get(token)
        if known is None:
            raise CheckpointError.at(f"{self.folder}: tokenizer", f"a token {token}", "none", _COPY)
        stated = self.content.get(key)
        if stated not in (None, known):
            where = f"{self._file}: {key}"
            raise CheckpointError.at(where, f"{known}, the tokenizer's id of {token}", shown(stated), _COPY)
        return int(known)

    @property
    def _file(self) -> Path:
        return self.folder / NETWORK_CONFIG

    def _one_of(self, key: str, value: Any, known: Iterable[str]) -> str:
        if value not in [*known]:
            raise CheckpointError.at(f"{self._file}: {key}", f"one of {', '.join(known)}", shown(value))
        return str(value)

    def _whole(self, key: str, value: Any, least: int = 1) -> int:
        if type(value) is not int or value < least:
            raise CheckpointError.at(f"{self._file}: {key}", f"a whole number of at least {least}", shown(value))
        return value

    def _use_meta(self) -> bool:
        stated = self.processor.get("use_meta")
        if stated is not None and type(stated) is not bool:
            raise CheckpointError.at(f"{self.folder / PROCESSOR_CONFIG}: use_meta", "true or false", shown(stated))
        return bool(self._assumed("use_meta", PUBLISHED["use_meta"]) if stated is None else stated)

    def _check_style(self) -> None:
        stated = self.processor.get("conversation_style")
        if stated not in (None, _STYLE):
            raise CheckpointError.at(f"{self.folder / PROCESSOR_CONFIG}: conversation_style", _STYLE, shown(stated))

    def _copies(self, key: str) -> int:
        count, other = self._whole(key, self._value(key)), self.processor.get(key)
        if other not in (None, count):
            where = f"{self.folder / PROCESSOR_CONFIG}: {key}"
            raise CheckpointError.at(where, f"{count}, as in {NETWORK_CONFIG}", shown(other), _COPY)
        return count

    def _head(self, key: str) -> HeadConfig:
        read = self._section(key)
        kind: Any = self._one_of(f"{key}.head_type", read["head_type"], ("bro", "linear"))
        activation = self._one_of(f"{key}.activation", read["activation"], ACTIVATIONS)
        width, depth = (self._whole(f"{key}.{name}", read[name], n) for name, n in (("hidden_dims", 1), ("depth", 0)))
        return HeadConfig(kind, width, depth, activation)

    def _bins(self, key: str) -> Bins:
        read = self._section(key)
        where = f"{self._file}: {key}"
        transform: Any = self._one_of(f"{key}.support_transform", read["support_transform"], get_args(Transform))
        count = self._whole(f"{key}.bins", read["bins"])
        ends = [read[name] for name in ("min_value", "max_value")]
        if not all(map(_is_number, ends)) or ends[0] > ends[1]:
            raise CheckpointError.at(where, "min_value, and a max_value that is not smaller", shown(ends))
        edges = _edges(read["bin_edges"], count, f"{where}.bin_edges") if transform == "quantile" else None
        return Bins(count, transform, float(ends[0]), float(ends[1]), edges)

    def _section(self, key: str) -> dict[str, Any]:
        """Return a section from config.json, with the published values for keys that it lacks."""
        stated = self._value(key)
        if not isinstance(stated, Mapping):
            raise CheckpointError.at(f"{self._file}: {key}", "settings", shown(stated))
        self._tell_unknown(f"{NETWORK_CONFIG}: {key}", stated, PUBLISHED[key].keys() | _IDLE)
        for name in PUBLISHED[key].keys() - stated.keys() - {"bin_edges"}:
            self._assumed(f"{key}.{name}", PUBLISHED[key][name])
        return {**PUBLISHED[key], **stated}

    def _value(self, key: str) -> Any:
        stated = self.content.get(key)
        return self._assumed(key, PUBLISHED[key]) if stated is None else stated

    def _assumed(self, name: str, value: Any) -> Any:
        self.assumptions.append(Assumption(name, value, "default, as the published checkpoints"))
        return value

    def _tell_unknown(self, where: str, content: Mapping[str, Any], known: Any) -> None:
        self.unexpected += [f"{where}: {shown(name)}" for name in sorted(content.keys() - known)]


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _edges(edges: Any, count: int, where: str) -> tuple[float, ...]:
    is_list = isinstance(edges, list) and len(edges) == count + 1 and all(map(_is_number, edges))
    if not is_list or any(last <= first for first, last in itertools.pairwise(edges)):
        expected = f"{count + 1} ascending numbers of seconds, as the transform is quantile"
        raise CheckpointError.at(where, expected, shown(edges), _COPY)
    return tuple(map(float, edges))


MODEL_TYPE = "rynn_value_lang"
_EXAMPLE = '--robot-description "a Franka single-arm robot" --camera-description "the main right camera"'


def reads(folder: Path) -> bool:
    """True if the folder holds a RynnValue as it was published, or an export of it."""
    return network_config(folder).get("model_type") == MODEL_TYPE or reward_model_of(folder) == RynnConfig.reward_model


def load(folder: Path, options: CheckpointConfig) -> Loaded:
    """Load a checkpoint from a local folder, with the user's processor and descriptions. Raises CheckpointError."""
    if is_saved(folder):
        checkpoint = reopened(RynnCheckpoint, folder, options)
        changed = _descriptions(options) if checkpoint.config.use_meta else {}
        return Loaded(replace(checkpoint, config=replace(checkpoint.config, **changed)))
    content = read_json(folder / NETWORK_CONFIG)
    if content.get("model_type") != MODEL_TYPE:
        got = shown(content.get("model_type"))
        raise CheckpointError.at(f"{folder / NETWORK_CONFIG}: model_type", f"{MODEL_TYPE}, of a RynnValue", got)
    return _published(folder, content, options)


def _published(folder: Path, content: dict[str, Any], options: CheckpointConfig) -> Loaded:
    """Load a checkpoint as it was published."""
    file = folder / NETWORK_CONFIG
    read = Settings.read(folder, content)
    fields = read.fields()
    rest = {name: value for name, value in content.items() if name not in PUBLISHED and "value_token_id" not in name}
    backbone = backbone_config({**rest, "model_type": QWEN3}, file)
    tensors, _ = read_published(folder, read_unrounded_config(backbone, file), MODEL_TYPE)
    weights = {name: each for name, each in renamed(tensors, QWEN_NAMES).items() if not UNUSED.fullmatch(name)}
    if EMBEDDING not in weights:
        raise CheckpointError.at(folder, f"a weight {EMBEDDING}", "none")
    backbone["text_config"]["vocab_size"] = len(weights[EMBEDDING])  # its padding may have been kept or cut
    processor = options.base_model or folder
    tokenizer, preprocessor = read_processor(processor)
    fields["value_token"] = read.token("value_token_id", VALUE_TOKEN, tokenizer)
    fields["relative_token"] = read.token("relative_value_token_id", RELATIVE_TOKEN, tokenizer)
    meta = _descriptions(options)
    if fields["use_meta"] and not meta:
        expected = "robot_description, camera_description or both, which the prompt of this checkpoint names"
        raise CheckpointError.at(folder, expected, "neither", f"for example {_EXAMPLE}")
    fields["dtype"], of_dtype = dtype_of(backbone, file)
    limits = pixel_limits(preprocessor, f"base model {processor}")
    config = RynnConfig(
        backbone=backbone,
        base_model_id=source_name(processor),
        weights=kind_of(weights),
        **{**fields, **limits, **(meta if fields["use_meta"] else {})},
    )
    notes = [f"{name}: not expected, and not used: scores may differ from the original's" for name in read.unexpected]
    checkpoint = RynnCheckpoint(config, weights, processor)
    checkpoint.check()
    return Loaded(checkpoint, (*of_dtype, *read.assumptions), lambda _checkpoint: notes)


def _descriptions(options: CheckpointConfig) -> dict[str, str]:
    """Return the user's descriptions for robot and camera, by setting."""
    return {name: words for name in META if (words := getattr(options, name))}


READER = Reader(reads, load)
