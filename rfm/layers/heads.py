# SPDX-License-Identifier: MIT
"""The prediction heads that every reward model family shares, and how their outputs are read."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rfm.layers.linear import Linear


class PredictionHead(nn.Sequential):
    """[..., D] hidden states -> [..., n] logits. The indices 0, 1 and 4 are the names in checkpoints."""

    def __init__(self, hidden_dim: int, num_outputs: int) -> None:
        super().__init__(
            Linear(hidden_dim, hidden_dim // 2),
            nn.LayerNorm(hidden_dim // 2),
            nn.GELU(),
            nn.Dropout(),  # holds its index; serving never trains
            Linear(hidden_dim // 2, num_outputs),
        )


def progress_from_logits(logits: Tensor) -> Tensor:
    """float32 [...] in 0..1 from the progress head's [..., n].

    n = 1: the sigmoid. n = K bins: the mean of the bins' centres linspace(0, 1, K) under the softmax,
    in float32 whatever the model's precision.
    """
    if logits.shape[-1] == 1:
        return logits.squeeze(-1).sigmoid().float()
    bins = torch.linspace(0.0, 1.0, logits.shape[-1], device=logits.device)
    return logits.float().softmax(dim=-1) @ bins
