# SPDX-License-Identifier: MIT
"""The demo checkpoint's networks: small served networks, and a head used only in training.

H x W pixels, Dv frame embedding width, Dt text embedding width.
"""

from __future__ import annotations

import string
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from demo_training.groups import HINT_DIM
from rfm.families.rewind.checkpoint import RewindCheckpoint
from rfm.families.rewind.encoders import Encoders, ImagePreprocessor
from rfm.families.rewind.network import RewindConfig, RewindTransformer
from rfm.files import WEIGHTS
from rfm.published.rewind import IMAGE_ENCODER_PREFIX, TEXT_ENCODER_PREFIX
from toy_world.tasks import COLOURS, TARGETS, TASKS, VERBS

IMAGE_SIZE_PX = 48
PATCH_SIZE_PX = 8
VIDEO_DIM = 64
TEXT_DIM = 32
MAX_TASK_TOKENS = 128
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
_INIT_STD = 0.1  # about 1 / sqrt(width); with large models' 0.02, narrow networks learn too slowly at first
_TEXT_GAIN = 6.0

CONFIG = RewindConfig(
    video_feature_dim=VIDEO_DIM,
    text_feature_dim=TEXT_DIM,
    hidden_dim=64,
    num_layers=4,
    num_attention_heads=4,
    max_len=32,
    causal_mask=True,
    use_per_frame_progress_token=True,
    progress_bins=10,
    has_similarity=True,
    trained_frames=32,
    trained_padding=False,
)


class Learner(nn.Module):
    """The trained networks: encoders, transformer, and a head that reads hints from a frame embedding."""

    def __init__(self) -> None:
        super().__init__()
        self.encoders = _encoders()
        self.image_model = self.encoders.image_model
        self.text_model = self.encoders.text_model
        self.network = _network()
        self.hint_head = nn.Linear(VIDEO_DIM, HINT_DIM)
        self.eval()  # no dropout: the networks are small, and data never repeat

    def embed_frames(self, frames: Tensor) -> Tensor:
        """Embed frames, uint8 [..., H, W, 3], like ``Encoders``, but with gradients: float32 [..., Dv]."""
        crops = self.encoders.preprocessor(frames.flatten(0, -4))
        return self.image_model(pixel_values=crops).pooler_output.unflatten(0, frames.shape[:-3])

    def embed_tasks(self, verb: str) -> Tensor:
        """Embed the TASKS sentences with ``verb``, like ``Encoders``, but with gradients: float32 [6, Dt]."""
        sentences = [task.sentence(verb) for task in TASKS]
        tokens = self.encoders.tokenizer(sentences, padding=True, return_tensors="pt")
        hidden = self.text_model(**tokens).last_hidden_state
        mask = tokens["attention_mask"].unsqueeze(-1).to(hidden.dtype)
        return (hidden * mask).sum(1) / mask.sum(1)


def _network() -> RewindTransformer:
    """Return the network, with a larger gain for tasks.

    Text embeddings are means over mostly the same words and differ little. Without the gain, training ignores them for
    long.
    """
    network = RewindTransformer(CONFIG)
    network.text_proj.weight.data *= _TEXT_GAIN
    network.text_position_embedding.data /= _TEXT_GAIN
    for tokens in (network.prog_token_A, network.prog_token_B):
        tokens.data = tokens.data[:, :1] + _waves(*tokens.shape[1:])
    return network


def _waves(length: int, width: int) -> Tensor:
    """Return sines and cosines of the position, [length, width], so that tokens encode time from the start."""
    position = torch.arange(length)[:, None]
    rates = 64.0 ** -torch.linspace(0, 1, width // 2)
    return torch.cat([torch.sin(position * rates), torch.cos(position * rates)], dim=1)


def write_checkpoint(learner: Learner, folder: Path) -> None:
    """Write ``checkpoint`` in upstream's layout, and its base models ``image_encoder`` and ``text_encoder``."""
    encoders = learner.encoders
    encoders.save(folder)
    RewindCheckpoint(CONFIG, learner.network.state_dict()).save(folder / "checkpoint")
    weights = load_file(folder / "checkpoint" / WEIGHTS)
    parts = ((IMAGE_ENCODER_PREFIX, encoders.image_model), (TEXT_ENCODER_PREFIX, encoders.text_model))
    for prefix, model in parts:
        weights |= {prefix + name: tensor.contiguous() for name, tensor in model.state_dict().items()}
    save_file(weights, folder / "checkpoint" / WEIGHTS, metadata={"format": "pt"})


def num_parameters(module: nn.Module) -> int:
    """Return a module's parameter count."""
    return sum(parameter.numel() for parameter in module.parameters())


def _encoders() -> Encoders:
    from transformers import BertConfig, BertModel, Dinov2Config, Dinov2Model

    image_model = Dinov2Model(
        Dinov2Config(
            hidden_size=VIDEO_DIM,
            num_hidden_layers=3,
            num_attention_heads=4,
            mlp_ratio=3,
            image_size=IMAGE_SIZE_PX,
            patch_size=PATCH_SIZE_PX,
            initializer_range=_INIT_STD,
        )
    )
    preprocessor = ImagePreprocessor(
        resize_px=IMAGE_SIZE_PX, crop_px=(IMAGE_SIZE_PX, IMAGE_SIZE_PX), mean=IMAGENET_MEAN, std=IMAGENET_STD
    )
    tokenizer = _tokenizer()
    text_model = BertModel(
        BertConfig(
            vocab_size=len(tokenizer),
            hidden_size=TEXT_DIM,
            num_hidden_layers=1,
            num_attention_heads=4,
            intermediate_size=2 * TEXT_DIM,
            max_position_embeddings=MAX_TASK_TOKENS,
            initializer_range=_INIT_STD,
        )
    )
    return Encoders(image_model, preprocessor, text_model, tokenizer)


def _tokenizer() -> Any:
    """Return a BERT tokenizer that keeps the tasks' words whole and splits others into letters."""
    from tokenizers import Tokenizer, normalizers, pre_tokenizers, processors
    from tokenizers.models import WordPiece
    from transformers import PreTrainedTokenizerFast

    special = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]"]
    letters = [*string.ascii_lowercase, *string.digits, *string.punctuation]
    words = [*COLOURS, *TARGETS, *VERBS, "the", "block", "in", "on"]
    tokens = [*special, *letters, *(f"##{letter}" for letter in letters), *words]
    vocabulary = {token: i for i, token in enumerate(tokens)}
    tokenizer = Tokenizer(WordPiece(vocabulary, unk_token="[UNK]"))
    tokenizer.normalizer = normalizers.BertNormalizer(lowercase=True)
    tokenizer.pre_tokenizer = pre_tokenizers.BertPreTokenizer()
    ends = [(token, vocabulary[token]) for token in ("[CLS]", "[SEP]")]
    tokenizer.post_processor = processors.TemplateProcessing(single="[CLS] $A [SEP]", special_tokens=ends)
    names = dict(zip(("pad_token", "unk_token", "cls_token", "sep_token", "mask_token"), special, strict=True))
    return PreTrainedTokenizerFast(tokenizer_object=tokenizer, model_max_length=MAX_TASK_TOKENS, **names)


def seeded_learner(seed: int) -> Learner:
    """Initialise the networks from a seed."""
    torch.manual_seed(seed)
    return Learner()
