# SPDX-License-Identifier: MIT
"""Models, tokenizers and preprocessing in transformers' files, from local folders or Hugging Face ids."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from rfm.checkpoint.files import check_finite
from rfm.checkpoint.preprocessor import PREPROCESSOR_CONFIG
from rfm.rewind.preprocessing import ImagePreprocessor

_LOADING_PROBLEMS = ("missing_keys", "unexpected_keys", "mismatched_keys")  # as transformers reports a load


def load_preprocessor(source: str | Path) -> ImagePreprocessor:
    """The preprocessing of an image model. Raises OSError and ValueError."""
    from transformers.utils.hub import cached_file

    config = json.loads(Path(str(cached_file(str(source), PREPROCESSOR_CONFIG))).read_text())
    return ImagePreprocessor.from_config(config, f"{source}/{PREPROCESSOR_CONFIG}")


def load_tokenizer(source: str | Path) -> Any:
    """The tokenizer of a text model. Raises OSError and ValueError."""
    from transformers import AutoTokenizer

    return AutoTokenizer.from_pretrained(str(source), use_fast=True, trust_remote_code=False)


def load_model(source: str | Path, weights: Mapping[str, Tensor] | None) -> Any:
    """The model of ``source``, with ``weights`` in place of its own. Raises ValueError unless they fit to the letter.

    transformers does the loading, since it knows how names of weights changed from release to release.
    """
    from transformers import AutoConfig, AutoModel

    with TemporaryDirectory() as folder:
        if weights is not None:
            AutoConfig.from_pretrained(str(source), trust_remote_code=False).save_pretrained(folder)
            tensors = {name: tensor.contiguous() for name, tensor in weights.items()}
            save_file(tensors, Path(folder) / "model.safetensors", metadata={"format": "pt"})
        try:
            model, loaded = AutoModel.from_pretrained(
                str(source) if weights is None else folder,
                use_safetensors=True,
                trust_remote_code=False,  # None would ask the user
                dtype=torch.float32,
                output_loading_info=True,
            )
        except RuntimeError as error:  # shapes
            raise ValueError(f"{source}: the encoder's weights do not fit: {error}") from error
    problems = ("missing_keys", "mismatched_keys") if weights is None else _LOADING_PROBLEMS
    found = {name: sorted(map(str, loaded[name])) for name in problems if loaded[name]}
    if found:  # transformers would leave missing ones random, and others out
        raise ValueError(f"{source}: the encoder's weights do not fit: {found}")
    check_finite(model.state_dict())
    return model
