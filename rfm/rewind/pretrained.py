# SPDX-License-Identifier: MIT
"""Models, tokenizers and preprocessing in transformers' files, from local folders or Hugging Face ids."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rfm.checkpoint.content import read_json
from rfm.checkpoint.files import check_finite, check_one_form
from rfm.checkpoint.preprocessor import PREPROCESSOR_CONFIG
from rfm.rewind.preprocessing import ImagePreprocessor

IMAGE_MODELS = ("dinov2", "dinov2_with_registers")  # whose pooled output is that of the class token
TEXT_MODELS = ("bert", "distilbert", "mpnet", "roberta", "xlm-roberta")  # of sentences
_LOADING_PROBLEMS = ("missing_keys", "unexpected_keys", "mismatched_keys")  # as transformers reports a load


def load_config(source: str | Path) -> Any:
    """The configuration of a model. Raises OSError and ValueError."""
    from transformers import AutoConfig

    return AutoConfig.from_pretrained(str(source), trust_remote_code=False)  # None would ask the user


def load_preprocessor(source: str | Path) -> ImagePreprocessor:
    """The preprocessing of an image model. Raises OSError, ValueError, CheckpointError."""
    from transformers.utils.hub import cached_file

    config = read_json(Path(str(cached_file(str(source), PREPROCESSOR_CONFIG))))
    return ImagePreprocessor.from_config(config, f"{source}/{PREPROCESSOR_CONFIG}")


def load_tokenizer(source: str | Path, vocab_size: int) -> Any:
    """The tokenizer of a text model with that many embeddings. Raises OSError and ValueError."""
    from transformers import AutoTokenizer

    expected = "files of a tokenizer (tokenizer.json, or vocab.txt), got none that can be read"
    try:
        tokenizer = AutoTokenizer.from_pretrained(str(source), use_fast=True, trust_remote_code=False)
    except TypeError as error:  # as transformers 4 says that there are none
        raise ValueError(f"{source}: expected {expected}: {error}") from error
    if not set(tokenizer.get_vocab()) - set(tokenizer.all_special_tokens):  # as transformers 5 makes one of no files
        raise ValueError(f"{source}: expected {expected}")
    if len(tokenizer) > vocab_size:
        raise ValueError(f"{source}: expected a tokenizer of at most {vocab_size} tokens, got {len(tokenizer)}")
    return tokenizer


def load_model(source: str | Path, weights: Mapping[str, Tensor] | None, known: Sequence[str]) -> Any:
    """The model of ``source``, with ``weights`` in place of its own.

    transformers does the loading, since it knows how names of weights changed from release to release.
    known: the types of models that may be there
    Raises OSError, CheckpointError, and ValueError for another type, or weights that do not fit to the letter.
    """
    from transformers import AutoModel

    options = {"dtype": torch.float32, "output_loading_info": True}
    config = load_config(source)
    if config.model_type not in known:
        raise ValueError(f"{source}: model_type: expected one of {', '.join(known)}, got {config.model_type}")
    if Path(source).is_dir():
        check_one_form(Path(source))
    try:
        if weights is None:
            model, loaded = AutoModel.from_pretrained(str(source), config=config, use_safetensors=True, **options)
        else:
            with torch.device("meta"):
                kind = type(AutoModel.from_config(config))
            model, loaded = kind.from_pretrained(None, config=config, state_dict=dict(weights), **options)
    except RuntimeError as error:  # shapes
        raise ValueError(f"{source}: the encoder's weights do not fit: {error}") from error
    problems = ("missing_keys", "mismatched_keys") if weights is None else _LOADING_PROBLEMS
    found = {name: sorted(map(str, loaded[name])) for name in problems if loaded[name]}
    if found:  # transformers would leave missing ones random, and others out
        raise ValueError(f"{source}: the encoder's weights do not fit: {found}")
    check_finite(model.state_dict())
    return model
