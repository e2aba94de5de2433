# SPDX-License-Identifier: MIT
"""Load ReWiND encoder files in transformers' format: settings, preprocessing, tokenizer, weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from rfm.engine.layers import Normalisation
from rfm.files import (
    MAX_UINT8,
    NETWORK_CONFIG,
    PIL_BICUBIC,
    PREPROCESSOR_CONFIG,
    check_one_form,
    local_copy,
    read_json,
)
from rfm.weights import check_values
from rfm_client.contract.description import FrameSize

IMAGE_MODELS = ("dinov2", "dinov2_with_registers")  # types whose pooled output is the class token's
TEXT_MODELS = ("bert", "distilbert", "mpnet", "roberta", "xlm-roberta")  # sentence encoder types
_LOADING_PROBLEMS = ("missing_keys", "unexpected_keys", "mismatched_keys")  # as transformers reports a load


@dataclass(frozen=True)
class ImagePreprocessor:
    """uint8 images -> normalised crops, bit-exact with transformers' "fast" (torchvision) Bit image processor.

    Resizes the shorter side to ``resize_px`` (bicubic, antialiased, on uint8), crops the centre to ``crop_px`` =
    (height, width), then computes (value - 255 mean) / (255 std) per channel.
    """

    resize_px: int
    crop_px: tuple[int, int]
    mean: tuple[float, ...]
    std: tuple[float, ...]

    @property
    def frame_size(self) -> FrameSize:
        """The size to which a frame is resized before the crop."""
        return FrameSize("shortest", (self.resize_px,))

    @classmethod
    def from_config(cls, config: Mapping[str, Any], where: str) -> ImagePreprocessor:
        """Read preprocessor_config.json's content. Raises ValueError for other steps."""
        size: Any = config.get("size")
        crop: Any = config.get("crop_size")
        if _is_count(size) and str(config.get("image_processor_type", "Bit")).startswith(("Bit", "CLIP")):
            size = {"shortest_edge": size}  # the older form, for processors that keep proportions
        if _is_count(crop):
            crop = {"height": crop, "width": crop}
        required = {
            "do_resize": True,
            "do_center_crop": True,
            "do_rescale": True,
            "do_normalize": True,
            "resample": PIL_BICUBIC,
        }
        for name, value in required.items():
            if config.get(name) != value:
                raise ValueError(f"{where}: {name}: expected {value}, got {config.get(name)}")
        if abs(config.get("rescale_factor", 0.0) - 1 / MAX_UINT8) > 1e-9:
            raise ValueError(f"{where}: rescale_factor: expected 1/255, got {config.get('rescale_factor')}")
        if not (_has_counts(size, "shortest_edge") and _has_counts(crop, "height", "width")):
            expected = "size {shortest_edge} and crop_size {height, width}"
            raise ValueError(f"{where}: expected {expected}, got {config.get('size')} and {config.get('crop_size')}")
        for name in ("image_mean", "image_std"):
            values = config.get(name)
            if not (isinstance(values, list) and len(values) == 3 and all(type(value) is float for value in values)):
                raise ValueError(f"{where}: {name}: expected three numbers, got {values}")
        return cls(
            resize_px=size["shortest_edge"],
            crop_px=(crop["height"], crop["width"]),
            mean=tuple(config["image_mean"]),
            std=tuple(config["image_std"]),
        )

    def to_config(self) -> dict[str, Any]:
        """Return the preprocessor_config.json fields that ``from_config`` reads."""
        return {
            "do_resize": True,
            "size": {"shortest_edge": self.resize_px},
            "resample": PIL_BICUBIC,
            "do_center_crop": True,
            "crop_size": dict(zip(("height", "width"), self.crop_px, strict=True)),
            "do_rescale": True,
            "rescale_factor": 1 / MAX_UINT8,
            "do_normalize": True,
            "image_mean": self.mean,
            "image_std": self.std,
            "image_processor_type": "BitImageProcessor",
        }

    def __call__(self, images: Tensor) -> Tensor:
        """Preprocess images on the CPU: uint8 [N, H, W, C = 3] -> float32 [N, C, *crop_px]."""
        return self.normalised(self.crops(images))

    def crops(self, images: Tensor) -> Tensor:
        """Resize and crop images: uint8 [N, H, W, C] -> [N, *crop_px, C].

        Runs on the CPU: only there can PyTorch resize uint8 with antialiasing.
        """
        return self._crop(self._resize(images.permute(0, 3, 1, 2))).permute(0, 2, 3, 1)

    def normalised(self, crops: Tensor) -> Tensor:
        """Normalise crops on any device: uint8 [N, *crop_px, C] -> float32 [N, C, *crop_px]."""
        return Normalisation(self.mean, self.std)(crops)

    def _resize(self, images: Tensor) -> Tensor:
        height, width = images.shape[-2:]
        short, long = min(height, width), max(height, width)
        resized = (self.resize_px, int(self.resize_px * long / short))
        size = resized if height <= width else resized[::-1]
        if size == (height, width):
            return images
        return F.interpolate(images, size, mode="bicubic", antialias=True)

    def _crop(self, images: Tensor) -> Tensor:
        height, width = images.shape[-2:]
        crop_height, crop_width = self.crop_px
        pad_height, pad_width = max(crop_height - height, 0), max(crop_width - width, 0)
        if pad_height or pad_width:
            sides = (pad_width // 2, (pad_width + 1) // 2, pad_height // 2, (pad_height + 1) // 2)
            images = F.pad(images, sides)
            height, width = images.shape[-2:]
        top, left = round((height - crop_height) / 2), round((width - crop_width) / 2)
        return images[..., top : top + crop_height, left : left + crop_width]


def _is_count(value: Any) -> bool:
    return type(value) is int and value > 0


def _has_counts(value: Any, *names: str) -> bool:
    return isinstance(value, dict) and set(value) == set(names) and all(map(_is_count, value.values()))


def load_config(source: str | Path, known: Sequence[str]) -> Any:
    """Load a model's configuration from its folder or id.

    known: accepted model types
    Raises OSError, CheckpointError, and ValueError for another type.
    """
    from transformers import AutoConfig

    folder = local_copy(source)
    kind = read_json(folder / NETWORK_CONFIG).get("model_type")
    if kind not in known:
        raise ValueError(f"{source}: model_type: expected one of {', '.join(known)}, got {kind}")
    return AutoConfig.from_pretrained(folder, trust_remote_code=False)  # None would prompt the user


def load_preprocessor(source: str | Path) -> ImagePreprocessor:
    """Load an image model's preprocessing. Raises OSError, ValueError, CheckpointError."""
    config = read_json(local_copy(source) / PREPROCESSOR_CONFIG)
    return ImagePreprocessor.from_config(config, f"{source}/{PREPROCESSOR_CONFIG}")


def load_tokenizer(source: str | Path, vocab_size: int) -> Any:
    """Load the tokenizer for a text model with ``vocab_size`` token embeddings. Raises OSError and ValueError."""
    from transformers import AutoTokenizer

    expected = "files of a tokenizer (tokenizer.json, or vocab.txt), got none that can be read"
    try:
        tokenizer = AutoTokenizer.from_pretrained(local_copy(source), use_fast=True, trust_remote_code=False)
    except TypeError as error:  # transformers 4, if there are no files
        raise ValueError(f"{source}: expected {expected}: {error}") from error
    if not set(tokenizer.get_vocab()) - set(tokenizer.all_special_tokens):  # transformers 5, if there are no files
        raise ValueError(f"{source}: expected {expected}")
    if len(tokenizer) > vocab_size:
        raise ValueError(f"{source}: expected a tokenizer of at most {vocab_size} tokens, got {len(tokenizer)}")
    return tokenizer


def load_model(source: str | Path, weights: Mapping[str, Tensor] | None, known: Sequence[str]) -> Any:
    """Load the model from ``source``; ``weights``, if given, replace its own.

    transformers loads the weights, since it knows how their names changed between releases.

    known: accepted model types
    Raises OSError, CheckpointError, and ValueError for another type or for weights that do not fit exactly.
    """
    from transformers import AutoModel

    options = {"dtype": torch.float32, "output_loading_info": True}
    config = load_config(source, known)
    folder = local_copy(source, with_weights=weights is None)
    check_one_form(folder)
    try:
        if weights is None:
            model, loaded = AutoModel.from_pretrained(folder, config=config, use_safetensors=True, **options)
        else:
            with torch.device("meta"):
                kind = type(AutoModel.from_config(config))
            model, loaded = kind.from_pretrained(None, config=config, state_dict=dict(weights), **options)
    except RuntimeError as error:  # shapes
        raise ValueError(f"{source}: the encoder's weights do not fit: {error}") from error
    problems = ("missing_keys", "mismatched_keys") if weights is None else _LOADING_PROBLEMS
    found = {name: sorted(map(str, loaded[name])) for name in problems if loaded[name]}
    if found:  # transformers would leave missing weights random and ignore the others
        raise ValueError(f"{source}: the encoder's weights do not fit: {found}")
    check_values(model.state_dict())
    return model
