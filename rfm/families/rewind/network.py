# SPDX-License-Identifier: MIT
"""The ReWiND transformer: frame and text embeddings in; progress, success, preference, similarity out.

B rows, L tokens in the longest row, N tokens in all rows, T frames in a trajectory, width D, K progress bins (1:
continuous progress).

A row is the token sequence ``[text] [first trajectory] ([second trajectory] [query])``. The network learns frame order
from the causal mask, from an embedding added to each trajectory's first frame and, in some checkpoints, from a progress
token behind each frame. There is no other positional encoding.
Rows are packed one after the other without padding, [N, D]. Only attention needs rows of equal length, [B, L, D].
Architecture: ReWiND (https://arxiv.org/abs/2505.10911) as in the public implementation ``reward_fm``.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rfm.engine.layers import Linear, PredictionHead, linear

_SIGNIFICANT_BITS = 5


def rounded_up(count: int) -> int:
    """Return the next number with at most five significant bits, at most 1/16 above ``count``.

    Tensors then have few shapes, and few kernels are built: some libraries build one for each shape.
    """
    step = 1 << max(count.bit_length() - _SIGNIFICANT_BITS, 0)
    return -(-count // step) * step


@dataclass(frozen=True)
class Packing:
    """The layout of packed rows: one after the other, then padding up to ``rounded_up(N)`` tokens, P in total.

    num_rows, longest, num_tokens: B, L and N
    at: int64 [P], each token's index in [B * L]; 0 for padding
    mask: bool [B, 1, 1, L], true at the row's tokens; None if all rows are equally long
    """

    num_rows: int
    longest: int
    num_tokens: int
    at: Tensor
    mask: Tensor | None

    @classmethod
    def of(cls, lengths: npt.NDArray[np.int64]) -> Packing:
        """Return the packing for rows with these token counts, int64 [B]."""
        num_rows, longest, num_tokens = len(lengths), int(lengths.max()), int(lengths.sum())
        at = np.zeros(rounded_up(num_tokens), np.int64)
        at[:num_tokens] = np.arange(num_tokens) + np.repeat(np.arange(num_rows) * longest - starts(lengths), lengths)
        mask = None
        if num_tokens < num_rows * longest:
            mask = torch.from_numpy(np.arange(longest) < lengths[:, None])[:, None, None]
        return cls(num_rows, longest, num_tokens, torch.from_numpy(at), mask)

    def to(self, device: torch.device) -> Packing:
        """Return the packing with its tensors on ``device``."""
        return replace(self, at=self.at.to(device), mask=None if self.mask is None else self.mask.to(device))

    def empty(self, width: int, like: Tensor) -> Tensor:
        """Return zeros [P, width] with the dtype and device of ``like``."""
        return like.new_zeros(len(self.at), width)

    def padded(self, packed: Tensor) -> Tensor:
        """Unpack tokens: [P, D] -> [B, L, D], with zeros behind each row's end."""
        tokens = packed[: self.num_tokens]
        if self.mask is not None:
            rows = packed.new_zeros(self.num_rows * self.longest, packed.shape[-1])
            rows[self.at[: self.num_tokens]] = tokens
            tokens = rows
        return tokens.unflatten(0, (self.num_rows, self.longest))

    def packed(self, padded: Tensor) -> Tensor:
        """Pack tokens: [B, L, D] -> [P, D]."""
        rows = padded.flatten(0, 1)
        is_packed = self.mask is None and len(rows) == len(self.at)
        return rows if is_packed else rows[self.at]


def starts(lengths: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return where B consecutive parts with these lengths start, int64 [B]."""
    return np.cumsum(lengths) - lengths


FEED_FORWARD_RATIO = 4


@dataclass(frozen=True)
class RewindConfig:
    """A network's configuration; fields from upstream's config.json keep their names.

    trained_frames: as in ``rfm_client.contract.description.Description``
    trained_padding: training padded shorter trajectories to ``trained_frames``, as upstream does; None: unknown
    """

    video_feature_dim: int
    text_feature_dim: int
    hidden_dim: int
    num_layers: int
    num_attention_heads: int
    max_len: int
    causal_mask: bool
    use_per_frame_progress_token: bool
    progress_bins: int
    has_similarity: bool
    trained_frames: int | None = None
    trained_padding: bool | None = None
    has_preference: bool = True
    has_success: bool = True

    @property
    def has_pairs(self) -> bool:
        """True if the network predicts preference or similarity, for two trajectories."""
        return self.has_preference or self.has_similarity

    @property
    def max_frames(self) -> int | None:
        """Frames in the longest trajectory that the network can score; None: no limit."""
        return self.max_len if self.use_per_frame_progress_token else None

    @property
    def tokens_per_frame(self) -> int:
        """Tokens that one frame adds to a row."""
        return 2 if self.use_per_frame_progress_token else 1

    def num_tokens(self, num_first: int, num_second: int) -> int:
        """Return how many tokens a row with these frame counts has; num_second = 0: a single trajectory."""
        query = 1 if num_second else 0
        return 1 + self.tokens_per_frame * (num_first + num_second) + query


@dataclass(frozen=True)
class RewindBatch:
    """Packed rows, whatever their length and kind, with F frames in total and Q queries (two-trajectory rows).

    text: float32 [B, Dt]
    video: float32 [V, Dv], frame embeddings, then padding
    shown: int64 [F], the frames' indices in ``video`` (in dense mode many rows show a frame); None: 0 to F - 1
    is_similarity: bool [Q], true for similarity, false for preference; None: all are preference
    packing: the token layout
    text_at, frame_at, query_at: int64 [B], [F], [Q], indices of packed tokens
    place: int64 [F], a frame's index in its trajectory, plus max_len in a second trajectory
    first_starts, second_starts: int64 [B], [Q], where first and second trajectories start among the F frames
    read_at: int64 [R], packed tokens whose outputs are read: each frame's last, each query, then padding
    """

    text: Tensor
    video: Tensor
    shown: Tensor | None
    is_similarity: Tensor | None
    packing: Packing
    text_at: Tensor
    frame_at: Tensor
    query_at: Tensor
    place: Tensor
    first_starts: Tensor
    second_starts: Tensor
    read_at: Tensor

    @classmethod
    def of(
        cls,
        config: RewindConfig,
        text: Tensor,
        video: Tensor,
        num_frames: npt.NDArray[np.int64],
        *,
        shown: Tensor | None = None,
        is_similarity: Tensor | None = None,
    ) -> RewindBatch:
        """Return the batch of rows with these frames.

        num_frames: int64 [B, 2], frames in the first and second trajectory; 0: no second trajectory
        others: as in the class
        Raises ValueError for a trajectory with more frames than progress tokens.
        """
        if config.max_frames is not None and num_frames.max() > config.max_frames:
            raise ValueError(f"num_frames: expected at most {config.max_frames}, got {num_frames.max()}")
        first, both = num_frames[:, 0], num_frames.sum(axis=1)
        has_query = num_frames[:, 1] > 0
        step = config.tokens_per_frame
        num_tokens = 1 + step * both + has_query
        text_at = starts(num_tokens)
        query_at = (text_at + num_tokens - 1)[has_query]
        in_row: npt.NDArray[np.int64] = np.arange(both.sum()) - np.repeat(starts(both), both)
        frame_at = np.repeat(text_at, both) + 1 + step * in_row
        lengths_of_first = np.repeat(first, both)
        is_second = in_row >= lengths_of_first
        place = np.where(is_second, in_row - lengths_of_first + config.max_len, in_row)
        second_starts = (starts(both) + first)[has_query]
        read_at = np.zeros(rounded_up(len(frame_at) + len(query_at)), np.int64)
        read_at[: len(frame_at)] = frame_at + step - 1
        read_at[len(frame_at) : len(frame_at) + len(query_at)] = query_at
        positions = (text_at, frame_at, query_at, place, starts(both), second_starts, read_at)
        packing = Packing.of(num_tokens)
        return cls(text, video, shown, is_similarity, packing, *map(torch.from_numpy, positions))

    def to(self, device: torch.device, dtype: torch.dtype) -> RewindBatch:
        """Return the batch on ``device``, with embeddings in ``dtype``."""
        parts: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        moved: dict[str, Any] = {name: None if part is None else part.to(device) for name, part in parts.items()}
        moved |= {name: moved[name].to(dtype) for name in ("text", "video")}
        return RewindBatch(**moved)


@dataclass(frozen=True)
class RewindOutput:
    """Logits for a RewindBatch: progress [F, K], success [F] (None without that head), query [Q]."""

    progress: Tensor
    success: Tensor | None
    query: Tensor


class SelfAttention(nn.Module):
    """Multi-head attention between packed tokens in the same row; parameter names follow nn.MultiheadAttention.

    The layer applies ``out_proj``, since it may need it only for some tokens.
    """

    def __init__(self, config: RewindConfig) -> None:
        super().__init__()
        width = config.hidden_dim
        self.num_heads = config.num_attention_heads
        self.is_causal = config.causal_mask
        self.in_proj_weight = nn.Parameter(torch.empty(3 * width, width))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * width))
        self.out_proj = Linear(width, width)
        nn.init.xavier_uniform_(self.in_proj_weight)

    def forward(self, x: Tensor, packing: Packing) -> Tensor:
        """Attend: [P, D] -> [P, D]. No token attends to padding behind its row."""
        padded = packing.padded(linear(x, self.in_proj_weight, self.in_proj_bias))
        queries, keys, values = padded.unflatten(-1, (3, self.num_heads, -1)).permute(2, 0, 3, 1, 4).unbind()
        mask = None if self.is_causal else packing.mask
        attended = F.scaled_dot_product_attention(queries, keys, values, attn_mask=mask, is_causal=self.is_causal)
        return packing.packed(attended.transpose(1, 2).flatten(2))


class EncoderLayer(nn.Module):
    """Post-norm transformer layer with ReLU; parameter names follow nn.TransformerEncoderLayer."""

    def __init__(self, config: RewindConfig) -> None:
        super().__init__()
        width = config.hidden_dim
        self.self_attn = SelfAttention(config)
        self.norm1 = nn.LayerNorm(width)
        self.linear1 = Linear(width, FEED_FORWARD_RATIO * width)
        self.linear2 = Linear(FEED_FORWARD_RATIO * width, width)
        self.norm2 = nn.LayerNorm(width)

    def forward(self, x: Tensor, packing: Packing, read_at: Tensor | None = None) -> Tensor:
        """Transform tokens: [P, D] -> [P, D], or [R, D] for the tokens ``read_at``, int64 [R]."""
        attended = self.self_attn(x, packing)
        if read_at is not None:
            attended, x = attended[read_at], x[read_at]
        x = self.norm1(self.self_attn.out_proj(attended, plus=x))
        return self.norm2(self.linear2(self.linear1(x, relu=True), plus=x))


class Encoder(nn.Module):
    """A stack of EncoderLayer; the last one computes only the tokens whose outputs are read."""

    def __init__(self, config: RewindConfig) -> None:
        super().__init__()
        self.layers = nn.ModuleList(EncoderLayer(config) for _ in range(config.num_layers))

    def forward(self, x: Tensor, packing: Packing, read_at: Tensor) -> Tensor:
        """Transform tokens: [P, D] -> [R, D], those at ``read_at``, int64 [R]."""
        for layer in self.layers[:-1]:
            x = layer(x, packing)
        return self.layers[-1](x, packing, read_at)


class RewindTransformer(nn.Module):
    """The ReWiND network; its state dict has upstream's names."""

    def __init__(self, config: RewindConfig) -> None:
        super().__init__()
        self.config = config
        width = config.hidden_dim
        self.video_proj = Linear(config.video_feature_dim, width)
        self.text_proj = Linear(config.text_feature_dim, width)
        self.first_embedding_A = nn.Parameter(torch.randn(1, 1, width))
        if config.has_pairs:
            self.first_embedding_B = nn.Parameter(torch.randn(1, 1, width))
        if config.use_per_frame_progress_token:
            self.text_position_embedding = nn.Parameter(torch.randn(1, 1, width))
            self.prog_token_A = nn.Parameter(torch.randn(1, config.max_len, width))
            self.prog_token_B = nn.Parameter(torch.randn(1, config.max_len, width))
        self.transformer = Encoder(config)
        self.progress_head = PredictionHead(width, config.progress_bins)
        if config.has_success:
            self.success_head = PredictionHead(width, 1)
        if config.has_preference:
            self.preference_token = nn.Parameter(torch.randn(1, 1, width))
            self.preference_head = PredictionHead(width, 1)
        if config.has_similarity:
            self.similarity_token = nn.Parameter(torch.randn(1, 1, width))
            self.similarity_head = PredictionHead(width, 1)

    def forward(self, batch: RewindBatch) -> RewindOutput:
        """Return the logits for every frame and query in the batch."""
        hidden = self.transformer(self._tokens(batch), batch.packing, batch.read_at)
        num_frames, num_queries = len(batch.frame_at), len(batch.query_at)
        query = self._query_scores(hidden[num_frames : num_frames + num_queries], batch)
        progress = self.progress_head(hidden)[:num_frames]
        success = self.success_head(hidden).squeeze(-1)[:num_frames] if self.config.has_success else None
        return RewindOutput(progress, success, query)

    def _tokens(self, batch: RewindBatch) -> Tensor:
        """Return the transformer's input, [P, D]."""
        text = self.text_proj(batch.text)
        frames = self.video_proj(batch.video)
        frames = frames[: len(batch.frame_at)] if batch.shown is None else frames[batch.shown]
        frames[batch.first_starts] += self.first_embedding_A[0]
        tokens = batch.packing.empty(self.config.hidden_dim, text)
        if self.config.use_per_frame_progress_token:
            text = text + self.text_position_embedding[0]
            of_places = torch.cat([self.prog_token_A[0], self.prog_token_B[0]])
            tokens[batch.frame_at + 1] = of_places[batch.place]
        if len(batch.query_at):
            frames[batch.second_starts] += self.first_embedding_B[0]
            tokens[batch.query_at] = self._query_tokens(batch)
        tokens[batch.text_at] = text
        tokens[batch.frame_at] = frames
        return tokens

    def _query_tokens(self, batch: RewindBatch) -> Tensor:
        """Return the query tokens, [Q, D], or [1, D] if all are equal."""
        if batch.is_similarity is None:
            return self.preference_token[0]
        if not self.config.has_preference:
            return self.similarity_token[0]
        return torch.where(batch.is_similarity[:, None], self.similarity_token[0], self.preference_token[0])

    def _query_scores(self, hidden: Tensor, batch: RewindBatch) -> Tensor:
        """Return logits [Q] from the query tokens' states [Q, D]."""
        if not len(hidden):
            return hidden[:, 0]
        if not self.config.has_preference:
            return self.similarity_head(hidden).squeeze(-1)
        preference = self.preference_head(hidden).squeeze(-1)
        if batch.is_similarity is None:
            return preference
        return torch.where(batch.is_similarity, self.similarity_head(hidden).squeeze(-1), preference)
