# SPDX-License-Identifier: MIT
"""The work of a sample on a vision-language network, counted without weights or a forward pass."""

from __future__ import annotations

import torch

from rfm.vlm.collator import QwenCollator
from rfm.vlm.network import BackboneConfig, build_backbone
from rfm.vlm.tree import trees
from rfm_client.contract import Sample

_VISION = "visual."  # beginning of parameters that patches pass
_EMBEDDING = "embed_tokens."  # looked up, not multiplied


def flop(config: BackboneConfig, collator: QwenCollator, sample: Sample) -> float:
    """Return the operations of a sample's products with weights: two for each parameter and each patch or token.

    The products of attention, about a tenth, and the heads are left out.
    Raises InvalidSampleError.
    """
    rows = collator.rows(sample)
    videos = dict.fromkeys(video for row in rows for video in row.videos)
    with torch.device("meta"):
        backbone = build_backbone(config, config.torch_dtype)
    counts = {name: weights.numel() for name, weights in backbone.named_parameters() if _EMBEDDING not in name}
    of_vision = sum(count for name, count in counts.items() if name.startswith(_VISION))
    num_patches = sum(collator.num_patches(video) for video in videos)
    if collator.makes_trees:
        rows = trees(rows, collator.visual_pad, are_images=collator.config.multi_image)
    num_tokens = sum(row.cost for row in rows)
    return 2.0 * (of_vision * num_patches + (sum(counts.values()) - of_vision) * num_tokens)
