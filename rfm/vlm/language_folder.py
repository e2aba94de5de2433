# SPDX-License-Identifier: MIT
"""Read the files of a Qwen-VL with its language head: of Hugging Face, or of an export."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from rfm.checkpoint.content import NETWORK_CONFIG, CheckpointError, is_there, read_json, shown
from rfm.checkpoint.provenance import Assumption, source_name
from rfm.checkpoint.weights import read_weights
from rfm.family import Options, VideoPrompt, Weights
from rfm.vlm.backbone import QWEN_2_5, QWEN_NAMES, Renames, backbone_config, renamed
from rfm.vlm.collator import QWEN3
from rfm.vlm.language import EMBEDDING, HEAD, REWARD_MODEL, LanguageConfig
from rfm.vlm.network import Dtype
from rfm.vlm.processor import PROCESSOR_FOLDER
from rfm.vlm.qwen_checkpoint import SETTINGS
from rfm.vlm.rounding import kind_of, read_published, read_unrounded_config, round_layers
from rfm.vlm.run_config import DTYPES
from rfm.vlm.video_prompt import decided

_NAMES: Renames = ((r"^model\.lm_head\.", "lm_head."), *QWEN_NAMES)
_TIED = "tie_word_embeddings"
ONLY_QWEN3 = {QWEN3: "Qwen3-VL"}
ANY_QWEN = {QWEN_2_5: "Qwen2.5-VL", **ONLY_QWEN3}

Config = TypeVar("Config", bound=LanguageConfig)


@dataclass(frozen=True)
class LanguageFolder:
    """The files of a Qwen-VL: of Hugging Face, or of an export.

    backbone: as ``BackboneConfig``'s
    settings: this project's settings, in an export; None: the folder is no export
    dtype: stated by config.json
    base_model: source of the tokenizer and processor
    video_prompt: form of the prompt, of a folder that is no export
    rounded: form of rounded layers; None: not rounded
    assumed: dtype, video_prompt and language_head, if no file of a folder that is no export proves them
    """

    folder: Path
    backbone: dict[str, Any]
    settings: dict[str, Any] | None
    weights: dict[str, Tensor]
    processor: str | Path
    dtype: str
    base_model: str
    video_prompt: VideoPrompt
    rounded: Weights | None = None
    assumed: tuple[Assumption, ...] = ()

    @classmethod
    def read(cls, folder: Path, options: Options, backbones: Mapping[str, str] = ONLY_QWEN3) -> LanguageFolder:
        """Read the folder. Raises CheckpointError if it is no Qwen-VL with a language head.

        backbones: names for the user of the networks that are read, by model_type
        """
        file = folder / NETWORK_CONFIG
        content = read_json(file)
        if content.get("model_type") not in backbones:
            expected = " or ".join(f"{kind}, of an ordinary {name}" for kind, name in backbones.items())
            raise CheckpointError.at(f"{file}: model_type", expected, shown(content.get("model_type")))
        settings = content.pop(SETTINGS, None)
        backbone = backbone_config(content, file)
        is_nf4 = read_unrounded_config(backbone, file)
        tensors = read_weights(folder) if settings is not None else read_published(folder, is_nf4)[0]
        weights = {name: tensor for name, tensor in renamed(tensors, _NAMES).items() if "inv_freq" not in name}
        if any(name.startswith("progress_head") for name in weights):
            raise CheckpointError.at(folder, "an ordinary Qwen3-VL", "reward heads: leave out --as")
        of_head = _tie(weights, backbone, file)
        own = folder / PROCESSOR_FOLDER
        processor = options.base_model or (own if is_there(own / "tokenizer.json") else folder)
        dtype, of_dtype = dtype_of(backbone, file)
        form, of_form = decided(options.video_prompt, backbone, NETWORK_CONFIG, may_be_saved_later=True)
        rounded = kind_of(weights) if settings is None else settings.get("weights")
        if rounded is None and options.weights is not None:
            weights, _ = round_layers(weights, {}, options.weights, getattr(torch, dtype))
            rounded = options.weights
        assumed = (*of_dtype, *of_form, *of_head) if settings is None else ()
        name = source_name(processor)
        return cls(folder, backbone, settings, weights, processor, dtype, name, form, rounded, assumed)

    @property
    def made_of(self) -> dict[str, Any]:
        """The fields of LanguageConfig for a folder that is no export."""
        return {
            "backbone": self.backbone,
            "dtype": self.dtype,
            "base_model_id": self.base_model,
            "video_prompt": self.video_prompt,
            "weights": self.rounded,
        }

    def saved(self, config: type[Config]) -> Config | None:
        """Return the configuration that ``LanguageCheckpoint.save`` wrote; None: the folder is no export.

        Raises CheckpointError for an export of another reward model.
        """
        if self.settings is None:
            return None
        if self.settings.get(REWARD_MODEL) != config.reward_model:
            got = shown(self.settings.get(REWARD_MODEL))
            raise CheckpointError.at(self.folder, f"an export of {config.reward_model}", f"one of {got}")
        fields = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in self.settings.items()
            if name != REWARD_MODEL
        }
        made: Any = config
        return cast(Config, made(**{"backbone": self.backbone, **fields, "weights": self.rounded}))

    def assumptions(self, config: LanguageConfig) -> tuple[Assumption, ...]:
        """Return the settings that nothing proves and that have an effect."""
        return tuple(each for each in self.assumed if not (config.multi_image and each.name == "video_prompt"))


def _tie(weights: dict[str, Tensor], config: Mapping[str, Any], file: Path) -> tuple[Assumption, ...]:
    """Drop a head that equals the embedding to which config.json ties it; return the head if it is assumed.

    transformers 4 (seen: 4.57.6) obeys text_config, and replaces a stored head; transformers 5 (seen: 5.23.0) obeys the
    outer setting, and keeps a stored head.
    Raises CheckpointError for a head that only one of them uses.
    """
    outer, text = (part.get(_TIED) is True for part in (config, config["text_config"]))
    head, embedding = weights.get(HEAD), weights.get(EMBEDDING)
    if head is None:
        if not (outer or text):
            raise CheckpointError.at(file.parent, f"{HEAD}, since {_TIED} is false", "none")
        if outer and text:
            return ()
        obeyed = "text_config alone, as transformers 4" if text else "the outer setting alone, as transformers 5"
        return (Assumption("language_head", "the embedding", f"{_TIED} of {obeyed} reads it"),)
    if embedding is None or not (outer or text):
        return ()
    if head.shape == embedding.shape and bool((head == embedding).all()):
        del weights[HEAD]
    elif text:
        where = f"{file}: text_config.{_TIED}"
        remedy = (
            "transformers 4 scores with the embedding, transformers 5 with the head. For the head, set it to false. "
            "For the embedding, load and save the model with transformers 4, which drops the head"
        )
        raise CheckpointError.at(where, f"false, since {HEAD} differs from the embedding", "true", remedy)
    return ()


def dtype_of(config: Mapping[str, Any], file: Path) -> tuple[Dtype, tuple[Assumption, ...]]:
    """Return the number type of the network, and the type as an assumption if config.json states none.

    Raises CheckpointError.
    """
    key = next((name for name in ("dtype", "torch_dtype") if config.get(name)), None)
    if key is None:
        return "bfloat16", (Assumption("dtype", "bfloat16", f"default, as {NETWORK_CONFIG} has no dtype"),)
    dtype = str(config[key]).removeprefix("torch.")
    if dtype not in DTYPES:
        raise CheckpointError.at(f"{file}: {key}", f"one of {', '.join(DTYPES)}", shown(dtype))
    return dtype, ()


def reward_model_of(folder: Path) -> str | None:
    """Return the reward model that an export's config.json names; None: there is none."""
    content = read_json(folder / NETWORK_CONFIG) if is_there(folder / NETWORK_CONFIG) else {}
    settings = content.get(SETTINGS)
    name = settings.get(REWARD_MODEL) if isinstance(settings, dict) else None
    return name if isinstance(name, str) else None
