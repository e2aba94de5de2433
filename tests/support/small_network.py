# SPDX-License-Identifier: MIT
"""The configuration of a small ReWiND network."""

from __future__ import annotations

from rfm.families.rewind.network import RewindConfig

SMALL = RewindConfig(
    video_feature_dim=12,
    text_feature_dim=6,
    hidden_dim=24,
    num_layers=2,
    num_attention_heads=3,
    max_len=8,
    causal_mask=True,
    use_per_frame_progress_token=True,
    progress_bins=5,
    has_similarity=True,
)
