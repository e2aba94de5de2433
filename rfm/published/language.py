# SPDX-License-Identifier: MIT
"""Read a Qwen-VL with its language head from files in Hugging Face's format."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor

from rfm.config import CheckpointConfig
from rfm.files import NETWORK_CONFIG, CheckpointError, is_there, network_config, read_json, shown
from rfm.published.provenance import HUB_FOLDER, Assumption, source_name
from rfm.published.qwen import QWEN_NAMES, Renames, backbone_config, decided, renamed
from rfm.published.robometer_run import DTYPES
from rfm.published.rounding import kind_of, read_published, read_unrounded_config
from rfm.published.run_config import find_run_config
from rfm.qwen.language import EMBEDDING, HEAD, LanguageCheckpoint
from rfm.qwen.network import QWEN3, QWEN_2_5, Dtype
from rfm.saved import PROCESSOR_FOLDER, reward_model_of

_NAMES: Renames = ((r"^model\.lm_head\.", "lm_head."), *QWEN_NAMES)
_TIED = "tie_word_embeddings"
ONLY_QWEN3 = {QWEN3: "Qwen3-VL"}
ANY_QWEN = {QWEN_2_5: "Qwen2.5-VL", **ONLY_QWEN3}
Made = TypeVar("Made", bound=LanguageCheckpoint)


@dataclass(frozen=True)
class LanguageFolder:
    """What the files in a Qwen-VL's folder say.

    made_of: the fields of LanguageConfig
    processor: source of the tokenizer and processor
    assumed: dtype, video_prompt and language_head, if no file proves them
    """

    made_of: dict[str, Any]
    weights: dict[str, Tensor]
    processor: str | Path
    assumed: tuple[Assumption, ...]

    @classmethod
    def read(cls, folder: Path, options: CheckpointConfig, backbones: Mapping[str, str] = ONLY_QWEN3) -> LanguageFolder:
        """Read the folder. Raises CheckpointError unless it holds a Qwen-VL with a language head.

        backbones: accepted networks: user-facing names by model_type
        """
        file = folder / NETWORK_CONFIG
        content = read_json(file)
        if content.get("model_type") not in [*backbones]:
            expected = " or ".join(f"{kind}, of an ordinary {name}" for kind, name in backbones.items())
            raise CheckpointError.at(f"{file}: model_type", expected, shown(content.get("model_type")))
        backbone = backbone_config(content, file)
        tensors, _ = read_published(folder, read_unrounded_config(backbone, file))
        weights = {name: tensor for name, tensor in renamed(tensors, _NAMES).items() if "inv_freq" not in name}
        if any(name.startswith("progress_head") for name in weights):
            raise CheckpointError.at(folder, "an ordinary Qwen3-VL", "reward heads: leave out --as")
        of_head = _tie(weights, backbone, file)
        own = folder / PROCESSOR_FOLDER
        processor = options.base_model or (own if is_there(own / "tokenizer.json") else folder)
        dtype, of_dtype = dtype_of(backbone, file)
        form, of_form = decided(options.video_prompt, backbone, NETWORK_CONFIG, may_be_saved_later=True)
        made_of = {
            "backbone": backbone,
            "dtype": dtype,
            "base_model_id": source_name(processor),
            "video_prompt": form,
            "weights": kind_of(weights),
        }
        return cls(made_of, weights, processor, (*of_dtype, *of_form, *of_head))

    def assumed_but(self, unused: str) -> tuple[Assumption, ...]:
        """Return the unproven settings without one that has no effect."""
        return tuple(each for each in self.assumed if each.name != unused)


def reopened(made: type[Made], folder: Path, options: CheckpointConfig) -> Made:
    """Load an export, with the processor that the user asks for. Raises CheckpointError."""
    checkpoint = made.restore(folder)
    return replace(checkpoint, processor=options.base_model or checkpoint.processor)


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
    """Return the network's number type, also as an assumption if config.json states none.

    Raises CheckpointError.
    """
    key = next((name for name in ("dtype", "torch_dtype") if config.get(name)), None)
    if key is None:
        return "bfloat16", (Assumption("dtype", "bfloat16", f"default, as {NETWORK_CONFIG} has no dtype"),)
    dtype = str(config[key]).removeprefix("torch.")
    if dtype not in DTYPES:
        raise CheckpointError.at(f"{file}: {key}", f"one of {', '.join(DTYPES)}", shown(dtype))
    return dtype, ()


GENERATION_CONFIG = "generation_config.json"
# GENERATION_CONFIG keys without effect on the likeliest token.
_IDLE_KEYS = {
    "_from_model_config", "bos_token_id", "do_sample", "eos_token_id", "max_length", "max_new_tokens", "pad_token_id",
    "temperature", "top_k", "top_p", "transformers_version", "use_cache",
}  # fmt: skip
_NEUTRAL = {"repetition_penalty": 1.0, "no_repeat_ngram_size": 0, "num_beams": 1, "min_length": 0}


def stops_of(folder: Path) -> tuple[int, ...]:
    """Return the tokens that end an answer. Raises CheckpointError for settings that change the likeliest token."""
    file = folder / GENERATION_CONFIG
    if not is_there(file):
        raise CheckpointError.at(file, "the file", "none", "copy it from the checkpoint as it was published")
    content = read_json(file)
    for key in sorted(content.keys() - _IDLE_KEYS):
        if key not in _NEUTRAL or content[key] not in (None, _NEUTRAL[key]):
            expected = f"{_NEUTRAL[key]}" if key in _NEUTRAL else "no such key"
            raise CheckpointError.at(f"{file}: {key}", expected, shown(content[key]), "remove it")
    stops = content.get("eos_token_id")
    found = stops if isinstance(stops, list) else [stops]
    if not found or not all(type(token) is int for token in found):
        raise CheckpointError.at(f"{file}: eos_token_id", "ids of tokens", shown(stops))
    return tuple(found)


def is_ours(name: str, backbones: Collection[str], folder: Path) -> bool:
    """True if the folder holds an export of reward model ``name``, or a Qwen-VL so named without a run file.

    name: lower case; the folder's name, or that of the Hub repository it was copied from, may have hyphens
    backbones: known backbones, by model_type
    """
    if (exported := reward_model_of(folder)) is not None:
        return exported == name
    names = [folder.resolve().name, *(part for part in folder.parts if part.startswith(HUB_FOLDER))]
    is_named = any(name in each.lower().replace("-", "").replace("_", "") for each in names)
    is_qwen = network_config(folder).get("model_type") in [*backbones]  # it may be a list, which has no hash
    return is_named and is_qwen and find_run_config(folder) is None
