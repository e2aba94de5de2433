# SPDX-License-Identifier: MIT
"""Upstream's ReWiND forward pass in stock torch modules, as the FastAPI evaluation server runs it for each request.

Follows upstream's code: ``nn.TransformerEncoder``, a causal mask built on every call, progress tokens interleaved by
stacking, and rows with equal length. State dict names match the checkpoint's.
B rows, T frames per trajectory, L tokens, D width, Dv frame embedding width, Dt text embedding width, K progress bins.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from rfm.families.rewind.checkpoint import RewindCheckpoint
from rfm.families.rewind.network import RewindConfig
from rfm.published import load as load_checkpoint

SampleType = Literal["progress", "preference", "similarity"]


class Scores(NamedTuple):
    """Raw scores: progress logits [B, T, K] and success logits [B, T]; for pairs also the second's, and query [B]."""

    progress: Tensor
    success: Tensor
    second_progress: Tensor | None = None
    second_success: Tensor | None = None
    query: Tensor | None = None


def _head(width: int, num_outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(width, width // 2),
        nn.LayerNorm(width // 2),
        nn.GELU(),
        nn.Dropout(),
        nn.Linear(width // 2, num_outputs),
    )


class UpstreamRewind(nn.Module):
    """The network in a ReWiND checkpoint."""

    def __init__(self, config: RewindConfig) -> None:
        super().__init__()
        self.config = config
        width = config.hidden_dim
        self.video_proj = nn.Linear(config.video_feature_dim, width)
        self.text_proj = nn.Linear(config.text_feature_dim, width)
        self.first_embedding_A = nn.Parameter(torch.randn(1, 1, width))
        self.first_embedding_B = nn.Parameter(torch.randn(1, 1, width))
        if config.use_per_frame_progress_token:
            self.text_position_embedding = nn.Parameter(torch.randn(1, 1, width))
            self.prog_token_A = nn.Parameter(torch.randn(1, config.max_len, width))
            self.prog_token_B = nn.Parameter(torch.randn(1, config.max_len, width))
        layer = nn.TransformerEncoderLayer(
            d_model=width, nhead=config.num_attention_heads, dim_feedforward=4 * width, batch_first=True
        )
        self.transformer = nn.TransformerEncoder(layer, num_layers=config.num_layers)
        self.progress_head = _head(width, config.progress_bins)
        self.success_head = _head(width, 1)
        self.preference_token = nn.Parameter(torch.randn(1, 1, width))
        self.preference_head = _head(width, 1)
        if config.has_similarity:
            self.similarity_token = nn.Parameter(torch.randn(1, 1, width))
            self.similarity_head = _head(width, 1)

    def forward(
        self, text: Tensor, first: Tensor, second: Tensor | None = None, sample_type: SampleType = "progress"
    ) -> Scores:
        """Score text [B, Dt], first [B, T, Dv] and, for pairs, second [B, T, Dv].

        Raises ValueError if first and second differ in shape.
        """
        text_token = self.text_proj(text).unsqueeze(1)
        if self.config.use_per_frame_progress_token:
            text_token = text_token + self.text_position_embedding
        first_tokens = self._trajectory_tokens(first, "A")
        if sample_type == "progress":
            hidden = self._encode(torch.cat([text_token, first_tokens], dim=1))
            return Scores(*self._frame_scores(hidden[:, 1:]))
        assert second is not None
        if first.shape != second.shape:
            raise ValueError(f"second: expected {list(first.shape)}, as the first trajectory, got {list(second.shape)}")
        is_preference = sample_type == "preference"
        query_token = self.preference_token if is_preference else self.similarity_token
        query_head = self.preference_head if is_preference else self.similarity_head
        second_tokens = self._trajectory_tokens(second, "B")
        query_tokens = query_token.expand(len(text), -1, -1)
        hidden = self._encode(torch.cat([text_token, first_tokens, second_tokens, query_tokens], dim=1))
        of_first, of_second = hidden[:, 1:-1].chunk(2, dim=1)
        query = query_head(hidden[:, -1]).squeeze(-1)
        return Scores(*self._frame_scores(of_first), *self._frame_scores(of_second), query)

    def _trajectory_tokens(self, video: Tensor, which: Literal["A", "B"]) -> Tensor:
        """Map [B, T, Dv] to [B, T, D], or to [B, 2T, D] with a progress token after each frame."""
        frames = self.video_proj(video)
        first_embedding = self.first_embedding_A if which == "A" else self.first_embedding_B
        frames = torch.cat([frames[:, :1] + first_embedding, frames[:, 1:]], dim=1)
        if not self.config.use_per_frame_progress_token:
            return frames
        batch_size, num_frames, width = frames.shape
        progress_token = self.prog_token_A if which == "A" else self.prog_token_B
        progress_tokens = progress_token[:, :num_frames].expand(batch_size, -1, -1)
        return torch.stack([frames, progress_tokens], dim=2).reshape(batch_size, 2 * num_frames, width)

    def _encode(self, tokens: Tensor) -> Tensor:
        """Apply the transformer to tokens [B, L, D]."""
        mask = None
        if self.config.causal_mask:
            mask = nn.Transformer.generate_square_subsequent_mask(tokens.shape[1], device=tokens.device)
        return self.transformer(tokens, mask=mask)

    def _frame_scores(self, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Return progress logits [B, T, K] and success logits [B, T] from a trajectory's tokens [B, T or 2T, D]."""
        read = hidden[:, 1::2] if self.config.use_per_frame_progress_token else hidden
        return self.progress_head(read), self.success_head(read).squeeze(-1)


def progress_of(logits: Tensor) -> Tensor:
    """Convert logits [..., T, K] to progress [..., T], 0 to 1: mean bin under the softmax; K = 1: sigmoid."""
    if logits.shape[-1] == 1:
        return logits.squeeze(-1).sigmoid()
    bins = torch.linspace(0, 1, logits.shape[-1], device=logits.device)
    return (logits.softmax(dim=-1) * bins).sum(dim=-1)


def load(folder: str | Path) -> UpstreamRewind:
    """Load the network from a ReWiND checkpoint folder, on the CPU. Raises CheckpointError, TypeError."""
    checkpoint = load_checkpoint(folder)
    if not isinstance(checkpoint, RewindCheckpoint):
        raise TypeError(f"{folder}: expected a ReWiND checkpoint, got {type(checkpoint).__name__}")
    network = UpstreamRewind(checkpoint.config)
    network.load_state_dict(checkpoint.network, strict=True)
    return network.eval().requires_grad_(False)
