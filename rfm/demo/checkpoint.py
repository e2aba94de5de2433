# SPDX-License-Identifier: MIT
"""A small ReWiND checkpoint with encoders, in upstream's layout, with seeded random weights.

It shows that everything is connected; its scores mean nothing. ``python -m rfm.demo.checkpoint FOLDER`` writes it.
"""

from __future__ import annotations

import string
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors.torch import load_file, save_file

from rfm.checkpoint import RewindCheckpoint, save
from rfm.checkpoint.files import WEIGHTS
from rfm.checkpoint.rewind import IMAGE_ENCODER_PREFIX, TEXT_ENCODER_PREFIX
from rfm.models.encoders import Encoders, ImagePreprocessor
from rfm.models.rewind import RewindConfig, RewindTransformer

SEED = 7
IMAGE_SIZE_PX = 56
PATCH_SIZE_PX = 14
VIDEO_DIM = 64
TEXT_DIM = 48
MAX_TASK_TOKENS = 128
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

CONFIG = RewindConfig(
    video_feature_dim=VIDEO_DIM,
    text_feature_dim=TEXT_DIM,
    hidden_dim=64,
    num_layers=2,
    num_attention_heads=4,
    max_len=32,
    causal_mask=True,
    use_per_frame_progress_token=True,
    progress_bins=10,
    has_similarity=True,
)


class DemoCheckpoint(NamedTuple):
    """Where it lies: the checkpoint folder, and the folders that stand for its encoders' base models."""

    checkpoint: Path
    image_encoder: Path
    text_encoder: Path


def write_random_checkpoint(folder: Path) -> DemoCheckpoint:
    """Writes the checkpoint into ``folder``; the same weights every time."""
    with torch.random.fork_rng():
        torch.manual_seed(SEED)
        network = RewindTransformer(CONFIG)
        encoders = _encoders()
    return write_checkpoint(folder, network, encoders)


def write_checkpoint(folder: Path, network: RewindTransformer, encoders: Encoders) -> DemoCheckpoint:
    """Writes network and encoders into ``folder`` as upstream's training leaves them."""
    written = DemoCheckpoint(folder / "checkpoint", folder / "image_encoder", folder / "text_encoder")
    encoders.save_pretrained(written.image_encoder, written.text_encoder)
    save(RewindCheckpoint(network.config, network.state_dict()), written.checkpoint)
    weights = load_file(written.checkpoint / WEIGHTS)
    parts = ((IMAGE_ENCODER_PREFIX, encoders.image_model), (TEXT_ENCODER_PREFIX, encoders.text_model))
    for prefix, model in parts:
        weights |= {prefix + name: tensor.contiguous() for name, tensor in model.state_dict().items()}
    save_file(weights, written.checkpoint / WEIGHTS, metadata={"format": "pt"})
    return written


def _encoders() -> Encoders:
    from transformers import BertConfig, BertModel, Dinov2Config, Dinov2Model

    image_model = Dinov2Model(
        Dinov2Config(
            hidden_size=VIDEO_DIM,
            num_hidden_layers=2,
            num_attention_heads=4,
            mlp_ratio=2,
            image_size=IMAGE_SIZE_PX,
            patch_size=PATCH_SIZE_PX,
        )
    )
    preprocessor = ImagePreprocessor(
        resize_px=IMAGE_SIZE_PX, crop_px=(IMAGE_SIZE_PX, IMAGE_SIZE_PX), mean=IMAGENET_MEAN, std=IMAGENET_STD
    )
    tokenizer = word_tokenizer(MAX_TASK_TOKENS)
    text_model = BertModel(
        BertConfig(
            vocab_size=len(tokenizer),
            hidden_size=TEXT_DIM,
            num_hidden_layers=2,
            num_attention_heads=4,
            intermediate_size=2 * TEXT_DIM,
            max_position_embeddings=MAX_TASK_TOKENS,
        )
    )
    return Encoders(image_model, preprocessor, text_model, tokenizer)


def word_tokenizer(max_tokens: int, words: Sequence[str] = ()) -> Any:
    """Reads ``words`` whole and all else letter by letter, in the way of a BERT tokenizer."""
    from tokenizers import Tokenizer, normalizers, pre_tokenizers, processors
    from tokenizers.models import WordPiece
    from transformers import PreTrainedTokenizerFast

    special = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]"]
    letters = [*string.ascii_lowercase, *string.digits, *string.punctuation]
    tokens = [*special, *letters, *(f"##{letter}" for letter in letters), *words]
    vocabulary = {token: i for i, token in enumerate(tokens)}
    tokenizer = Tokenizer(WordPiece(vocabulary, unk_token="[UNK]"))
    tokenizer.normalizer = normalizers.BertNormalizer(lowercase=True)
    tokenizer.pre_tokenizer = pre_tokenizers.BertPreTokenizer()
    ends = [(token, vocabulary[token]) for token in ("[CLS]", "[SEP]")]
    tokenizer.post_processor = processors.TemplateProcessing(single="[CLS] $A [SEP]", special_tokens=ends)
    names = dict(zip(("pad_token", "unk_token", "cls_token", "sep_token", "mask_token"), special, strict=True))
    return PreTrainedTokenizerFast(tokenizer_object=tokenizer, model_max_length=max_tokens, **names)


if __name__ == "__main__":
    write_random_checkpoint(Path(sys.argv[1]))
