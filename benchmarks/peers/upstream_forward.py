# SPDX-License-Identifier: MIT
"""Upstream's ReWiND forward pass for progress in stock torch modules, as the FastAPI evaluation server runs it.

Follows upstream's code: ``nn.TransformerEncoder``, a causal mask built on every call, progress tokens interleaved by
stacking, and rows with equal length. State dict names match the checkpoint's.
B rows, T frames per trajectory, Dv frame embedding width, Dt text embedding width, K progress bins.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from rfm.families.rewind.checkpoint import RewindCheckpoint
from rfm.families.rewind.network import RewindConfig
from rfm.published import load as load_checkpoint


def _head(width: int, num_outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(width, width // 2),
        nn.LayerNorm(width // 2),
        nn.GELU(),
        nn.Dropout(),
        nn.Linear(width // 2, num_outputs),
    )


class UpstreamRewind(nn.Module):
    """The part of a ReWiND checkpoint's network that scores progress and success."""

    def __init__(self, config: RewindConfig) -> None:
        super().__init__()
        self.config = config
        width = config.hidden_dim
        self.video_proj = nn.Linear(config.video_feature_dim, width)
        self.text_proj = nn.Linear(config.text_feature_dim, width)
        self.first_embedding_A = nn.Parameter(torch.randn(1, 1, width))
        if config.use_per_frame_progress_token:
            self.text_position_embedding = nn.Parameter(torch.randn(1, 1, width))
            self.prog_token_A = nn.Parameter(torch.randn(1, config.max_len, width))
        layer = nn.TransformerEncoderLayer(
            d_model=width, nhead=config.num_attention_heads, dim_feedforward=4 * width, batch_first=True
        )
        self.transformer = nn.TransformerEncoder(layer, num_layers=config.num_layers)
        self.progress_head = _head(width, config.progress_bins)
        self.success_head = _head(width, 1)

    def forward(self, text: Tensor, video: Tensor) -> tuple[Tensor, Tensor]:
        """Return progress logits [B, T, K] and success logits [B, T] for text [B, Dt] and video [B, T, Dv]."""
        config = self.config
        text_token = self.text_proj(text).unsqueeze(1)
        tokens = self.video_proj(video)
        tokens = torch.cat([tokens[:, :1] + self.first_embedding_A, tokens[:, 1:]], dim=1)
        if config.use_per_frame_progress_token:
            text_token = text_token + self.text_position_embedding
            progress_tokens = self.prog_token_A[:, : tokens.shape[1]].expand(len(tokens), -1, -1)
            tokens = torch.stack([tokens, progress_tokens], dim=2).flatten(1, 2)
        tokens = torch.cat([text_token, tokens], dim=1)
        mask = None
        if config.causal_mask:
            mask = nn.Transformer.generate_square_subsequent_mask(tokens.shape[1], device=tokens.device)
        hidden = self.transformer(tokens, mask=mask)[:, 1:]
        read = hidden[:, 1::2] if config.use_per_frame_progress_token else hidden
        return self.progress_head(read), self.success_head(read).squeeze(-1)


def load(folder: str | Path) -> UpstreamRewind:
    """Load the network from a ReWiND checkpoint folder, on the CPU. Raises CheckpointError, TypeError."""
    checkpoint = load_checkpoint(folder)
    if not isinstance(checkpoint, RewindCheckpoint):
        raise TypeError(f"{folder}: expected a ReWiND checkpoint, got {type(checkpoint).__name__}")
    network = UpstreamRewind(checkpoint.config)
    network.load_state_dict({name: checkpoint.network[name] for name in network.state_dict()})
    return network.eval().requires_grad_(False)
