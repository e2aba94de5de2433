# SPDX-License-Identifier: MIT
"""The forward pass of the Qwen backbones, through the layers of ``transformers``' modules, in which no step waits.

Where everything stands is worked out on the host beforehand: the device is asked for nothing, so that it never runs out
of work. Numbers and order of sums are those of ``transformers`` 4.57.

Language model: B conversations of L tokens, D width, M visual tokens of all conversations. Text goes on by one in all
three coordinates. An image or a video is a box: each of its tokens stands where it is in it, and what follows goes on
behind the box's largest coordinate. Padding stands behind the tokens, where causal attention does not see it: no mask
is needed, and PyTorch's fastest attention takes none.

Vision tower: a shot is an image or one temporal group of a video; attention never crosses from one into another. N
patches, in the order of the shots, those that are merged next to each other; S of one shot, U = MERGE x MERGE of one
merged token. Shots of one size are one call, where transformers computes one shot after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from rfm.checkpoint.content import CheckpointError
from rfm.vlm.images import MERGE, Grid


@dataclass(frozen=True)
class Box:
    """An image or video among the tokens.

    start: its first token
    groups, rows, columns: of its merged tokens
    step: coordinates from one temporal group to the next
    """

    start: int
    groups: int
    rows: int
    columns: int
    step: int = 1

    @property
    def num_tokens(self) -> int:
        """How many tokens it takes."""
        return self.groups * self.rows * self.columns


def positions(length: int, boxes: Sequence[Box]) -> npt.NDArray[np.int64]:
    """int64 [3, L]: time, row and column of each token; ``boxes`` in the order in which they stand."""
    found = np.empty((3, length), np.int64)
    read = following = 0  # tokens that have their positions; the coordinate of the next one
    for box in boxes:
        text = box.start - read
        found[:, read : box.start] = np.arange(following, following + text)
        inside = np.indices((box.groups, box.rows, box.columns)).reshape(3, -1)
        inside[0] *= box.step
        read = box.start + box.num_tokens
        found[:, box.start : read] = inside + following + text
        following += text + 1 + max((box.groups - 1) * box.step, box.rows - 1, box.columns - 1)
    found[:, read:] = np.arange(following, following + length - read)
    return found


UNIT = MERGE**2

Runs = tuple[tuple[int, int], ...]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True)
class VisionPlan:
    """What a vision tower must know of the shots of a batch.

    shots: of each size how many there are, and patches of one
    positions: int64 [sum of S, 2], row and column of the patches of one shot of each size
    corners, weights: of Qwen3-VL int64 and float32 [4, sum of S]: the learned positions around each of these patches
    windows: of Qwen2.5-VL how many windows of how many patches there are, one behind the other
    order: of Qwen2.5-VL int64 [N / U], the merged tokens in the order of the windows
    back: its inverse
    """

    shots: Runs
    positions: Tensor
    corners: Tensor | None = None
    weights: Tensor | None = None
    windows: Runs | None = None
    order: Tensor | None = None
    back: Tensor | None = None

    def changed(self, change: Callable[[Tensor], Tensor]) -> VisionPlan:
        """The same with ``change`` made to its tensors."""
        changed: dict[str, Any] = {
            name: change(value) for name, value in vars(self).items() if isinstance(value, Tensor)
        }
        return replace(self, **changed)


def plan(grids: Sequence[Grid], config: dict[str, Any]) -> VisionPlan:
    """The plan for shots of these sizes, on the CPU.

    grids: of each size; its groups are the shots of that size
    config: of the vision tower, as config.json has it
    """
    sizes = [(grid.rows, grid.columns) for grid in grids]
    shots = tuple((grid.groups, grid.rows * grid.columns) for grid in grids)
    positions = torch.cat([_positions(*size) for size in sizes])
    if "num_position_embeddings" in config:
        side = int(config["num_position_embeddings"] ** 0.5)
        corners, weights = zip(*(_corners(*size, side) for size in sizes), strict=True)
        return VisionPlan(shots, positions, torch.cat(corners, dim=1), torch.cat(weights, dim=1))
    side = config["window_size"] // MERGE // config["patch_size"]
    windows, order = _windows(grids, side)
    return VisionPlan(
        shots, positions, windows=windows, order=torch.from_numpy(order), back=torch.from_numpy(np.argsort(order))
    )


def features(visual: Any, patches: Tensor, plan: VisionPlan) -> Tensor:
    """[N / U, levels, D] of patches [N, C * T * P * P]: the merged tokens of all shots, and those of Qwen3-VL's deeper
    layers.

    visual: transformers' vision tower; of it only the layers are used
    """
    hidden = visual.patch_embed(patches)
    if plan.corners is not None:
        hidden = hidden + _repeated(_learned_positions(visual.pos_embed, plan), plan.shots)
    turned = _turned(visual.rotary_pos_emb.inv_freq, plan)
    if plan.order is not None:
        hidden = _moved(hidden, plan.order)
    full = set(getattr(visual, "fullatt_block_indexes", range(len(visual.blocks))))
    deeper = list(getattr(visual, "deepstack_visual_indexes", ()))
    of_deeper = {}
    for number, block in enumerate(visual.blocks):
        hidden = hidden + _attention(block.attn, block.norm1(hidden), turned, plan, is_full=number in full)
        hidden = hidden + block.mlp(block.norm2(hidden))
        if number in deeper:
            at = deeper.index(number)
            of_deeper[at] = visual.deepstack_merger_list[at](hidden)
    merged = visual.merger(hidden)
    levels = torch.stack([merged, *(of_deeper[at] for at in sorted(of_deeper))], dim=1)
    return levels if plan.back is None else levels[plan.back]


def _attention(attention: Any, hidden: Tensor, turned: Turn, plan: VisionPlan, *, is_full: bool) -> Tensor:
    """[N, D] of [N, D], within each shot, or within each window; all of one size in one call."""
    heads = attention.qkv(hidden).reshape(len(hidden), 3, attention.num_heads, -1)
    query, key, value = heads.unbind(1)
    query, key = turned(query), turned(key)
    is_moved = is_full and plan.order is not None
    if is_moved:
        query, key, value = (_moved(each, plan.back) for each in (query, key, value))
    runs = plan.shots if is_full or plan.windows is None else plan.windows
    counts = [count * length for count, length in runs]
    parts = zip(runs, query.split(counts), key.split(counts), value.split(counts), strict=True)
    mixed = torch.cat([_within(*part, scale=attention.scaling) for part in parts])
    return attention.proj(_moved(mixed, plan.order) if is_moved else mixed)


def _within(run: tuple[int, int], query: Tensor, key: Tensor, value: Tensor, *, scale: float) -> Tensor:
    """[N, D] of [N, heads, D / heads]: attention within each of the sequences, N = how many there are * the length."""
    query, key, value = (each.unflatten(0, run).transpose(1, 2) for each in (query, key, value))
    return F.scaled_dot_product_attention(query, key, value, scale=scale).transpose(1, 2).flatten(2).flatten(0, 1)


@dataclass(frozen=True)
class Turn:
    """The rotation of queries and keys by their positions: float32 [N, 1, D / heads]."""

    cosine: Tensor
    sine: Tensor

    def __call__(self, heads: Tensor) -> Tensor:
        """[N, heads, D / heads] of the same; computed in float32."""
        values = heads.float()
        first, second = values.chunk(2, dim=-1)
        turned = values * self.cosine + torch.cat((-second, first), dim=-1) * self.sine
        return turned.to(heads.dtype)


def _turned(frequencies: Tensor, plan: VisionPlan) -> Turn:
    angles = (plan.positions[..., None].to(frequencies.dtype) * frequencies).flatten(1)
    angles = _repeated(torch.cat((angles, angles), dim=-1), plan.shots)
    if plan.order is not None:
        angles = _moved(angles, plan.order)
    return Turn(angles.cos().float()[:, None], angles.sin().float()[:, None])


def _learned_positions(embedding: Any, plan: VisionPlan) -> Tensor:
    """[sum of S, D]: learned positions, interpolated."""
    assert plan.corners is not None
    assert plan.weights is not None
    around = embedding(plan.corners) * plan.weights.to(embedding.weight.dtype)[..., None]
    return around[0] + around[1] + around[2] + around[3]


def _repeated(of_sizes: Tensor, shots: Runs) -> Tensor:
    """[N, ...] of [sum of S, ...]: what is the same for all shots of a size."""
    parts = of_sizes.split([length for _, length in shots])
    return torch.cat([part.repeat(count, 1) for part, (count, _) in zip(parts, shots, strict=True)])


def _moved(patches: Tensor, order: Tensor | None) -> Tensor:
    """[N, ...] of [N, ...]: the merged tokens' patches in another order."""
    return patches.unflatten(0, (-1, UNIT))[order].flatten(0, 1)


@lru_cache(maxsize=256)
def _positions(rows: int, columns: int) -> Tensor:
    """int64 [S, 2], row and column of each patch."""
    indices = np.indices((rows, columns)).reshape(2, rows // MERGE, MERGE, columns // MERGE, MERGE)
    return torch.from_numpy(np.ascontiguousarray(indices.transpose(1, 3, 2, 4, 0).reshape(-1, 2)))


@lru_cache(maxsize=256)
def _corners(rows: int, columns: int, side: int) -> tuple[Tensor, Tensor]:
    """int64 and float32 [4, S]: the four learned positions, of side x side, around each patch, and their shares."""
    of_axes = []
    for count in (rows, columns):
        at = torch.linspace(0, side - 1, count)
        low = at.int()
        of_axes.append((low, (low + 1).clip(max=side - 1), at - low))
    (top, bottom, down), (left, right, across) = of_axes
    corners = [(row[:, None] * side + column[None]) for row in (top, bottom) for column in (left, right)]
    weights = [(of_row[:, None] * of_column[None]) for of_row in (1 - down, down) for of_column in (1 - across, across)]
    at = _positions(rows, columns)
    places = at[:, 0] * columns + at[:, 1]
    return (
        torch.stack([corner.flatten()[places] for corner in corners]).long(),
        torch.stack([weight.flatten()[places] for weight in weights]),
    )


@lru_cache(maxsize=256)
def _windows_of(rows: int, columns: int, side: int) -> dict[int, Indices]:
    """By the merged tokens of a window, int64 [windows, tokens]: the merged tokens of one shot, window by window."""
    tokens = np.arange(rows * columns).reshape(rows, columns)
    found: dict[int, list[Indices]] = {}
    for top in range(0, rows, side):
        for left in range(0, columns, side):
            window = tokens[top : top + side, left : left + side].ravel()
            found.setdefault(len(window), []).append(window)
    return {length: np.stack(windows) for length, windows in found.items()}


def _windows(grids: Sequence[Grid], side: int) -> tuple[Runs, Indices]:
    """How many windows of how many patches there are, and the merged tokens in their order."""
    runs, order, start = [], [], 0
    for grid in grids:
        for length, windows in _windows_of(grid.rows // MERGE, grid.columns // MERGE, side).items():
            shots = start + np.arange(grid.groups) * grid.tokens_per_group
            order.append((shots[:, None, None] + windows).ravel())
            runs.append((grid.groups * len(windows), length * UNIT))
        start += grid.groups * grid.tokens_per_group
    return tuple(runs), np.concatenate(order)


FULL_ATTENTION = "full_attention"


def last_hidden_state(language: Any, inputs: dict[str, Tensor], features: Tensor) -> Tensor:
    """[B, L, D], behind the final norm.

    language: transformers' language model
    inputs: of a batch on its device
    input_ids: int64 [B, L]; position_ids: int64 [3, B, L]
    visual_tokens: int64 [M], where visual tokens stand among all B * L
    visual_features: int64 [M], which of the shots' merged tokens each of them is
    features: [N, levels, D], the merged tokens of all shots
    """
    at, picked = inputs["visual_tokens"], inputs["visual_features"]
    merged, *deeper = features.unbind(1)
    hidden = language.embed_tokens(inputs["input_ids"])
    hidden.flatten(0, 1).index_copy_(0, at, merged[picked].to(hidden.dtype))
    turned = language.rotary_emb(hidden, inputs["position_ids"])
    for number, layer in enumerate(language.layers):
        hidden = layer(hidden, position_embeddings=turned, attention_mask=None)
        hidden = hidden[0] if isinstance(hidden, tuple) else hidden  # transformers 4.57 of Qwen2.5-VL
        if number < len(deeper):
            hidden.flatten(0, 1).index_add_(0, at, deeper[number][picked].to(hidden.dtype))
    return language.norm(hidden)


def check_attention(backbone: Any) -> None:
    """Raises CheckpointError for a language model with layers that do not see all tokens before."""
    kinds = set(getattr(backbone.config.get_text_config(), "layer_types", None) or [FULL_ATTENTION])
    if kinds != {FULL_ATTENTION}:
        raise CheckpointError(f"text_config.layer_types: expected {FULL_ATTENTION} alone, got {sorted(kinds)}")
