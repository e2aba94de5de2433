# SPDX-License-Identifier: MIT
"""Count the GPU memory of published networks by the form of their weights, without a GPU and without weights.

    python benchmarks/memory.py

At rest: the weights. At most: the weights, and the tensors that live at the same time in a forward pass of the default
token budget, in bfloat16, with 8 frames of 480x640 in a sample. Not counted: CUDA itself (about 0.5 GiB), the feature
cache (256 MiB), memory that PyTorch reserves, and the keys and values of written answers.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import Any
from unittest import mock

import numpy as np
import torch
import torch.nn.functional as F
from engine import ALL_LAYERS, TEXT, VISION
from real_size import GOLDEN, TASK, USUAL_PX, VOCABULARY
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from rfm import families
from rfm.config import DEFAULT_TOKEN_BUDGET
from rfm.vlm.network import VlmRewardModel, build_backbone, qwen_states
from rfm.vlm.predictor import VlmPredictor
from rfm.vlm.rounding import round_layers
from rfm_client import ProgressSample, Trajectory

META = torch.device("meta")
GIB = 2**30
NUM_FRAMES = 8
# Fields of config.json that differ from Qwen3-VL-4B's: of the language model, and of the vision tower.
SIZES: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Any]]] = {
    "Qwen3-VL-2B": (
        {"hidden_size": 2048, "intermediate_size": 6144, "num_attention_heads": 16, "num_hidden_layers": 28},
        {"out_hidden_size": 2048},
    ),
    "Qwen3-VL-4B": ({"num_hidden_layers": ALL_LAYERS}, {}),
    "Qwen3-VL-8B": (
        {"hidden_size": 4096, "intermediate_size": 12288, "num_hidden_layers": ALL_LAYERS},
        {
            "hidden_size": 1152, "intermediate_size": 4304, "depth": 27, "out_hidden_size": 4096,
            "deepstack_visual_indexes": [8, 16, 24],
        },
    ),
}  # fmt: skip


class Live(TorchDispatchMode):
    """Counts the bytes of all tensors that operators make, while they live."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self.most = 0
        self._seen: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        before = {each.untyped_storage()._cdata for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)}
        made = func(*args, **(kwargs or {}))
        for storage in (each.untyped_storage() for each in tree_leaves(made) if isinstance(each, Tensor)):
            if storage._cdata in before or storage._cdata in self._seen:
                continue
            self._seen.add(storage._cdata)
            self.now += storage.nbytes()
            weakref.finalize(storage, self._end, storage._cdata, storage.nbytes())
        self.most = max(self.most, self.now)
        return made

    def _end(self, key: int, num_bytes: int) -> None:
        self._seen.discard(key)
        self.now -= num_bytes


def attention(query: Tensor, key: Tensor, value: Tensor, *_: Any, **__: Any) -> Tensor:
    """Return a tensor like flash attention's output, which keeps no scores."""
    return torch.empty_like(query.transpose(1, 2), memory_format=torch.contiguous_format).transpose(1, 2)


def network_of(size: str) -> tuple[Any, VlmRewardModel]:
    """Return a small checkpoint, and a network of Robometer in a published size, on the meta device."""
    folder = GOLDEN / "vlm" / "q3_tok_disc10_bf16" / "checkpoint"
    small: Any = families.load(folder, base_model=str(GOLDEN / "vlm" / "bases" / "q3"))
    of_text, of_vision = SIZES[size]
    text = {**small.config.backbone["text_config"], **TEXT, **of_text, "vocab_size": VOCABULARY}
    vision = {**small.config.backbone["vision_config"], **VISION, **of_vision}
    backbone = {**small.config.backbone, "text_config": text, "vision_config": vision}
    config = replace(small.config, backbone=backbone, dtype="bfloat16")
    with META:
        return small, VlmRewardModel(config, build_backbone(config, torch.bfloat16)).to(torch.bfloat16)


def at_rest(network: VlmRewardModel, kind: Any) -> int:
    """Return the bytes of the weights. kind: int8 or nf4; None: bfloat16"""
    weights = dict(network.named_parameters())
    with META, torch.no_grad():
        rounded = weights if kind is None else round_layers(weights, {}, kind, torch.bfloat16)[0]
    return sum(tensor.numel() * tensor.element_size() for tensor in rounded.values())


def of_a_pass(small: Any, network: VlmRewardModel) -> int:
    """Return the most bytes that live at once in a forward pass, without the weights."""
    collator = type(small.collator)(network.config, small.collator.tokenizer, small.collator.images)
    network.eval()
    predictor = VlmPredictor(network, collator, META)
    frames = np.zeros((NUM_FRAMES, *USUAL_PX, 3), np.uint8)
    (row,) = predictor.rows(ProgressSample(Trajectory(frames=frames, task=TASK)))
    # Rows have different frames, so that they share no encoding.
    count = DEFAULT_TOKEN_BUDGET // row.num_tokens
    rows = [
        predictor.rows(ProgressSample(Trajectory(frames=frames + np.uint8(index), task=TASK)))[0]
        for index in range(count)
    ]
    batch = predictor.collator.collate(_sized(predictor, rows)).to(META, torch.bfloat16)
    # transformers turns autocast off by the device's name, which the meta device does not know.
    without = mock.patch.object(torch, "autocast", lambda *_, **__: nullcontext())
    with without, mock.patch.object(F, "scaled_dot_product_attention", attention), Live() as live, torch.no_grad():
        qwen_states(network.model, batch)
    return live.most + sum(tensor.nbytes for tensor in batch.inputs.values())


def _sized(predictor: VlmPredictor, rows: Any) -> Any:
    for video in (video for row in rows for video in row.videos):
        video.sized = predictor.collator.to_size(video, None)
    return rows


def main() -> None:
    """Print the table."""
    print("| network | weights | at rest, GiB | at most, GiB |\n|---|---|---|---|")
    for size in SIZES:
        small, network = network_of(size)
        forward = of_a_pass(small, network)
        layer = max(parameter.numel() for name, parameter in network.named_parameters() if ".layers." in name)
        for kind in (None, "int8", "nf4"):
            rest = at_rest(network, kind)
            most = rest + forward + (0 if kind is None else layer * torch.bfloat16.itemsize)
            print(f"| {size} | {kind or 'bfloat16'} | {rest / GIB:.1f} | {most / GIB:.1f} |")


if __name__ == "__main__":
    main()
