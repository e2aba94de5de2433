# SPDX-License-Identifier: MIT
"""config.yaml from a vision-language training run: the settings that weights do not hold.

``make reference`` writes SETTINGS and the defaults into docs/reference/checkpoints.md.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args

from torch import Tensor

from rfm.families.robometer.network import VlmConfig
from rfm.files import (
    ADAPTER_CONFIG,
    NETWORK_CONFIG,
    RUN_CONFIG,
    CheckpointError,
    cut,
    read_json,
    read_run_config,
    shown,
)
from rfm.published.provenance import UPSTREAM_DEFAULT, Assumption, file_name, source_name
from rfm.published.qwen import Renames, renamed
from rfm.published.run_config import check_lerobot, find_run_config, frame_count
from rfm.qwen.lora import MERGE
from rfm.qwen.network import QWEN_2_5, Dtype
from rfm_client.contract.checks import require

HEADS, VQA = "default", "vqa"  # values for model.model_type: reward heads, generated text
DTYPES: tuple[Dtype, ...] = get_args(Dtype)
POOLINGS = ("mean", "boundary", "attention")
_SECTIONS = ("model", "data", "training", "peft")
# The run configuration keys that decide fields of VlmConfig; two keys must agree.
SETTINGS = {
    "dtype": ("model.torch_dtype",),
    "multi_image": ("model.use_multi_image", "data.use_multi_image"),
    "per_frame_progress_token": ("model.use_per_frame_progress_token", "data.use_per_frame_progress_token"),
    "frame_pooling": ("model.frame_pooling",),
    "pooling_temperature": ("model.frame_pooling_attn_temperature",),
    "average_temporal_patches": ("model.average_temporal_patches",),
    "progress_in_preference": ("training.predict_pref_progress",),
    "size_px": ("data.resized_height", "data.resized_width"),
    "trained_frames": ("data.max_frames",),
}
_FEW_BITS = re.compile(r"-bnb-4bit/?$")  # Unsloth's names for base models in NF4, on which it trains
_VARIANT = re.compile(r"(-unsloth)?(-bnb-4bit)?$")  # Unsloth's names for its copies of a base model
_DROPPED = ("pairwise_progress", "use_progress_token")  # prompt settings that upstream has dropped
Value = TypeVar("Value", bool, str, float)


@dataclass(frozen=True)
class RunConfig:
    """The sections in a run's config.yaml. As upstream, a null means that the key is missing.

    file: path of config.yaml
    name: its path relative to the checkpoint's folder
    has_sections: False: the file has no sections, and messages name only the key
    """

    file: Path
    name: str
    sections: dict[str, dict[str, Any]]
    has_sections: bool = True

    @classmethod
    def of(cls, folder: Path) -> RunConfig:
        """Read the run configuration for the checkpoint in ``folder``.

        Raises CheckpointError if there is none, or it is not upstream's.
        """
        file = find_run_config(folder)
        if file is None:
            raise CheckpointError.at(
                folder,
                f"{RUN_CONFIG} of the training run there, in the folder above, or on main of its Hub repository",
                "none: weights do not tell how the model was shown frames",
                f"copy the run's {RUN_CONFIG} into the folder; with an ordinary vision-language model, say --as which "
                "reward model it is asked",
            )
        content = read_run_config(file)
        sections = {name: content.get(name) or {} for name in _SECTIONS}
        for name, section in sections.items():
            if not isinstance(section, dict):
                raise CheckpointError.at(f"{file}: {name}", "a mapping", shown(section))
        require(f"{file}: model", bool(sections["model"]), "the settings of the training run", "none", CheckpointError)
        return cls(file, file_name(file, folder), sections)

    def check_model_type(self) -> None:
        """Raise CheckpointError for a checkpoint without reward heads, or with prompts that upstream has dropped."""
        if (model_type := self.get("model.model_type", HEADS)) != HEADS:
            remedy = "models that answer in generated text are not served" if model_type == VQA else ""
            raise CheckpointError.at(f"{self.file}: model.model_type", HEADS, shown(model_type), remedy)
        for section in ("model", "data"):
            for key in _DROPPED:
                if self.get(f"{section}.{key}", False):
                    expected = "false (upstream dropped this way to prompt a model)"
                    raise CheckpointError.at(f"{self.file}: {section}.{key}", expected, "true")

    def network(self) -> dict[str, Any]:
        """Return the fields of VlmConfig about the network and its prompts, except the frame size.

        Raises CheckpointError.
        """
        temperature = self.get("model.frame_pooling_attn_temperature", 1.0)
        if not 0 < temperature < math.inf:
            where = f"{self.file}: {self.shown('model.frame_pooling_attn_temperature')}"
            raise CheckpointError.at(where, "a number above 0", shown(temperature))
        return {
            "dtype": self._one_of("model.torch_dtype", "bfloat16", DTYPES),
            "multi_image": self._of_either("multi_image"),
            "per_frame_progress_token": self._of_either("per_frame_progress_token"),
            "frame_pooling": self._one_of("model.frame_pooling", "mean", POOLINGS),
            "pooling_temperature": temperature,
            "average_temporal_patches": self.get("model.average_temporal_patches", False),
            "progress_in_preference": self.get("training.predict_pref_progress", False),
            "base_model_id": self.get("model.base_model_id", ""),
            "trained_frames": frame_count(
                self.sections["data"].get("max_frames"), f"{self.file}: {self.shown('data.max_frames')}"
            ),
        }

    def size_px(self, multi_image: bool) -> tuple[int, int] | None:
        """Return height and width to which every frame is resized first; None: resizing starts from each frame's size.

        None for images, for which all upstream versions with a frame_pool_attn ignore the keys.
        Raises CheckpointError.
        """
        if multi_image:
            return None
        keys = ("resized_height", "resized_width")
        for key in keys:
            if key not in self.sections["data"]:  # upstream's default changed from 224 to null
                raise CheckpointError.at(f"{self.file}: data.{key}", "a number or null", "no such key")
        height, width = (frame_count(self.sections["data"].get(key), f"{self.file}: data.{key}") for key in keys)
        return None if height is None or width is None else (height, width)

    def shown(self, place: str) -> str:
        """Return ``section.key`` as the file has it."""
        return place if self.has_sections else place.partition(".")[2]

    def states(self, place: str) -> bool:
        """True if there is a value at ``section.key``."""
        section, _, key = place.partition(".")
        return self.sections[section].get(key) is not None

    def get(self, place: str, default: Value) -> Value:
        """Return the value at ``section.key``, otherwise the default. Raises CheckpointError for another type."""
        section, _, key = place.partition(".")
        value = self.sections[section].get(key)
        if value is None:
            return default
        if type(value) is int and type(default) is float:
            value = float(value)
        if type(value) is not type(default):
            raise CheckpointError.at(f"{self.file}: {self.shown(place)}", f"{type(default).__name__}", shown(value))
        return value

    def _one_of(self, place: str, default: str, known: tuple[str, ...]) -> str:
        value = self.get(place, default).removeprefix("torch.")
        require(f"{self.file}: {self.shown(place)}", value in known, f"one of {known}", shown(value), CheckpointError)
        return value

    def _of_either(self, setting: str) -> bool:
        """Return a setting that upstream has twice: its network reads ``model``, its collator ``data``."""
        places = [place for place in SETTINGS[setting] if self.states(place)]
        values = {place: self.get(place, False) for place in places}
        if len(set(values.values())) > 1:
            got = " and ".join(f"{place} {str(value).lower()}" for place, value in values.items())
            mend = "set both to how the run showed frames"
            raise CheckpointError.at(self.file, f"{' and '.join(places)} to agree", got, mend)
        return any(values.values())


def base_of_adapter(folder: Path, run: RunConfig) -> str:
    """Return the base model that the run names, or the NF4 form of it that the adapter names.

    Raises CheckpointError if the adapter names another, or if the run began with a checkpoint, whose weights the
    adapter may change.
    """
    base = run.get("model.base_model_id", "")
    if not base:
        raise CheckpointError.at(run.file, "model.base_model_id (or --base-model)", "none")
    named = read_json(folder / ADAPTER_CONFIG).get("base_model_name_or_path")
    where = f"{folder / ADAPTER_CONFIG}: base_model_name_or_path"
    if named and _model_name(str(named)) != _model_name(base):
        remedy = "name the one that the adapter was trained on with --base-model"
        raise CheckpointError.at(where, f"{cut(base)}, the model.base_model_id of {run.file}", shown(named), remedy)
    began_with = run.get("training.load_from_checkpoint", "")
    if began_with:
        got = f"{shown(began_with)}: the adapter may change its weights in place of those of {cut(base)}"
        remedy = f"{MERGE}; if it does change those of {cut(base)}, name them with --base-model"
        raise CheckpointError.at(f"{run.file}: training.load_from_checkpoint", "none beside an adapter", got, remedy)
    return named if isinstance(named, str) and _FEW_BITS.search(named) else base


def assumptions_of(
    config: VlmConfig, run: RunConfig, base_model: str | None, num_nf4: int = 0
) -> tuple[Assumption, ...]:
    """Return a checkpoint's settings that neither weights nor files prove.

    base_model: the caller's option
    num_nf4: how many weights are in NF4, which may have been rounded after training
    """
    idle = {"average_temporal_patches", "size_px"} if config.multi_image else set()  # settings without effect
    idle |= set() if config.pools_images else {"frame_pooling"}
    idle |= set() if config.pools_by_attention else {"pooling_temperature"}
    found = []
    named = config.base_model_id
    if base_model is not None and named and _model_name(named) not in base_model.lower():
        found.append(Assumption("base_model", source_name(base_model), f"--base-model, for {named} of {run.name}"))
    for name, places in SETTINGS.items():
        value = getattr(config, name)
        if name not in idle and value is not None and not any(map(run.states, places)):
            source = f"{UPSTREAM_DEFAULT}, as {run.name} has no {run.shown(places[0])}"
            found.append(Assumption(name, value, source))
    reads_videos = config.family == QWEN_2_5 and not config.multi_image
    if reads_videos and config.backbone.get("transformers_version") is None:
        source = "default: no file names transformers 4"
        found.append(Assumption("positions_behind_videos", "as transformers 4", source))
    if num_nf4:
        rounded = f"{num_nf4} in NF4 of bitsandbytes"
        found.append(Assumption("rounded_weights", rounded, "weights, rounded in training too"))
    return tuple(found)


def _model_name(base: str) -> str:
    """Return the name by which ids and paths for the same base model are compared."""
    return _VARIANT.sub("", base.rstrip("/").rpartition("/")[2].lower())


LEROBOT_TYPE = "robometer"  # the value of config.json's key ``type``
LEROBOT_BACKBONE = "vlm_config"  # the key of the backbone's configuration
_LEROBOT_NAMES: Renames = ((r"^model\.model\.", "model."),)
_EMBEDDING, _TEXT_HEAD = "model.language_model.embed_tokens.weight", "model.lm_head.weight"
# Keys in config.json that decide scores, by their section in a Robometer run's config.yaml.
_DECIDING = {
    "model": (
        "average_temporal_patches", "base_model_id", "frame_pooling", "frame_pooling_attn_temperature", "torch_dtype",
        "use_multi_image", "use_per_frame_progress_token",
    ),
    "data": ("max_frames",),
}  # fmt: skip
_BINS, _LOSS, _LOSSES = "progress_discrete_bins", "progress_loss_type", ("discrete", "l1", "l2")


def is_lerobot(content: Mapping[str, Any]) -> bool:
    """True if this config.json comes from LeRobot's Robometer."""
    return content.get("type") == LEROBOT_TYPE


def lerobot_run(content: Mapping[str, Any], file: Path) -> RunConfig:
    """Return the settings in LeRobot's config.json. Raises CheckpointError for a missing, null or unknown key."""
    needed = (LEROBOT_BACKBONE, *_DECIDING["model"])
    check_lerobot(content, file, needed, {_BINS, _LOSS, *_DECIDING["data"], "reward_output"})
    sections = {name: {key: content.get(key) for key in keys} for name, keys in _DECIDING.items()}
    sections["data"] |= {"resized_height": None, "resized_width": None}  # LeRobot has no common frame size
    return RunConfig(file, NETWORK_CONFIG, {"training": {}, "peft": {}, **sections}, has_sections=False)


def lerobot_weights(tensors: Mapping[str, Tensor], backbone: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the weights under the network's names.

    If text head and embedding are tied, LeRobot's file holds the tensor once, as the text head's.
    """
    weights = renamed(tensors, _LEROBOT_NAMES)
    if backbone.get("tie_word_embeddings") and _EMBEDDING not in weights and _TEXT_HEAD in weights:
        weights[_EMBEDDING] = weights.pop(_TEXT_HEAD)
    return weights


def check_bins(content: Mapping[str, Any], weights: Mapping[str, Tensor], file: Path) -> None:
    """Raise CheckpointError if config.json and the weights disagree about progress bins."""
    loss, bins = content.get(_LOSS), content.get(_BINS)
    if loss not in _LOSSES:
        raise CheckpointError.at(f"{file}: {_LOSS}", f"one of {', '.join(_LOSSES)}", shown(loss))
    head = weights.get("progress_head.4.weight")
    stated = bins if loss == "discrete" else 1
    if head is not None and len(head) != stated:
        got = f"{shown(bins)} with {_LOSS} {loss}; correct what the run did not have"
        raise CheckpointError.at(f"{file}: {_BINS}", f"{len(head)} outputs, as progress_head has", got)
