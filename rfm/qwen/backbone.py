# SPDX-License-Identifier: MIT
"""The forward pass of the Qwen backbones, on the parameters of ``transformers``, without synchronisation.

The host computes all positions and indices beforehand and never waits for the device, so the device always has work.
Results and summation order match ``transformers`` 4.57.

Language model: B conversations, L tokens, width D, M visual tokens in total. A token has three coordinates: time, row
and column. From one text token to the next, all three grow by 1. An image or video is a box, and a token's coordinates
are its place in that box. The text behind a box continues after the box's largest coordinate. Padding follows the
tokens, where causal attention cannot see it. This avoids a mask, which PyTorch's fastest attention does not accept.

Vision tower: a shot is a temporal patch, that is, an image or two video frames. Attention stays within a shot. There
are N patches in all shots, S in one shot and U = MERGE x MERGE in one merged token; a merged token's patches are
adjacent. Shots with equal sizes share a call; transformers computes them one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from rfm.engine.layers import concatenated
from rfm.qwen.decoder_layer import Cache, DecoderLayer, decoder_layers, turn_of
from rfm.qwen.images import MERGE, Grid


@dataclass(frozen=True)
class Box:
    """The merged tokens of an image or video in a conversation.

    start: index of the first token
    groups: how many temporal patches there are
    rows, columns: merged tokens per temporal patch
    step: difference in time coordinate between temporal patches
    """

    start: int
    groups: int
    rows: int
    columns: int
    step: int = 1

    @property
    def num_tokens(self) -> int:
        """How many tokens the box has."""
        return self.groups * self.rows * self.columns


def positions(length: int, boxes: Sequence[Box]) -> npt.NDArray[np.int64]:
    """Return time, row and column of ``length`` = L tokens, int64 [3, L]; ``boxes`` in order."""
    found = np.empty((3, length), np.int64)
    read = following = 0  # tokens with positions so far; the next text token's coordinate
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
    """The layout of a batch's shots for a vision tower.

    shots: shot count and S for every shot size
    positions: int64 [sum of S, 2], row and column of the patches, one shot per size
    corners, weights: Qwen3-VL: int64 and float32 [4, sum of S], learned positions around these patches, their weights
    windows: Qwen2.5-VL: runs of equal windows, as window count and patches per window
    order: Qwen2.5-VL: int64 [N / U], the merged tokens in window order
    back: the inverse permutation of ``order``
    """

    shots: Runs
    positions: Tensor
    corners: Tensor | None = None
    weights: Tensor | None = None
    windows: Runs | None = None
    order: Tensor | None = None
    back: Tensor | None = None


def plan(grids: Sequence[Grid], config: dict[str, Any]) -> VisionPlan:
    """Return the plan for shots with these sizes, on the CPU.

    grids: one per size, where ``groups`` counts the shots
    config: vision_config in config.json
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
    """Return the features of all merged tokens, [N / U, levels, D], from patches [N, C * T * P * P].

    levels: 1; Qwen3-VL adds deeper layers
    C = 3 channels, T = 2 frames, P: patch side in pixels
    visual: transformers' vision tower; only its layers are used
    """
    hidden = embedded(visual.patch_embed.proj, patches)
    if plan.corners is not None and plan.weights is not None:
        around = visual.pos_embed(plan.corners) * plan.weights.to(visual.pos_embed.weight.dtype)[..., None]
        hidden = hidden + _repeated(around[0] + around[1] + around[2] + around[3], plan.shots)
    of_shots, of_windows = _runs(visual.rotary_pos_emb.inv_freq, plan)
    if plan.order is not None:
        hidden = _moved(hidden, plan.order)
    full = set(getattr(visual, "fullatt_block_indexes", range(len(visual.blocks))))
    deeper = list(getattr(visual, "deepstack_visual_indexes", ()))
    of_deeper = dict[int, Tensor]()
    for number, block in enumerate(visual.blocks):
        x, is_moved = block.norm1(hidden), plan.order is not None and number in full
        qkv = block.attn.qkv(_moved(x, plan.back) if is_moved else x)
        mixed = _attention(block.attn, qkv, of_shots if number in full else of_windows)
        hidden = hidden + block.attn.proj(_moved(mixed, plan.order) if is_moved else mixed)
        hidden = hidden + block.mlp(block.norm2(hidden))
        if number in deeper:
            at = deeper.index(number)
            of_deeper[at] = visual.deepstack_merger_list[at](hidden)
    merged = visual.merger(hidden)
    levels = torch.stack([merged, *(of_deeper[at] for at in sorted(of_deeper))], dim=1)
    return levels if plan.back is None else levels[plan.back]


def embedded(projection: Any, patches: Tensor) -> Tensor:
    """Embed patches with one matrix product: [N, C * T * P * P] -> [N, D].

    ``projection`` is a Conv3d whose kernel equals its stride. Some cuDNN versions compute this convolution wrongly or
    very slowly in bfloat16 (pytorch issue 163539, transformers issue 45750).
    """
    weight: Tensor = projection.weight
    return F.linear(patches.to(weight.dtype), weight.flatten(1), projection.bias)


@dataclass(frozen=True)
class Run:
    """Sequences with ``length`` patches each, and their rotary embedding.

    cosine, sine: float32 [count, 1, length, D / heads], or without the first two if all sequences have the same. The
        first half of the sines is negated, so queries and keys need no negation.
    """

    count: int
    length: int
    cosine: Tensor
    sine: Tensor


def _attention(attention: Any, qkv: Tensor, runs: Sequence[Run]) -> Tensor:
    """Attend within the sequences, equal sizes in one call: [N, 3 D] -> [N, D]."""
    parts = qkv.split([run.count * run.length for run in runs]) if len(runs) > 1 else [qkv]
    return concatenated([_within(attention, *each) for each in zip(parts, runs, strict=True)])


def _within(attention: Any, qkv: Tensor, run: Run) -> Tensor:
    """Attend within equal sequences, with queries and keys turned in float32: [N, 3 D] -> [N, D]."""
    heads = qkv.view(run.count, run.length, 3, attention.num_heads, -1).permute(2, 0, 3, 1, 4)
    both, value = heads[:2], heads[2]
    first, second = both.chunk(2, dim=-1)
    turned = (both * run.cosine + torch.cat((second, first), dim=-1) * run.sine).to(qkv.dtype)
    query, key = turned.unbind()
    mixed = F.scaled_dot_product_attention(query, key, value, scale=attention.scaling)
    return mixed.transpose(1, 2).reshape(len(qkv), -1)


def _runs(frequencies: Tensor, plan: VisionPlan) -> tuple[list[Run], list[Run]]:
    """Return the runs of shots and of windows; both are shots without windows."""
    angles = (plan.positions[..., None].to(frequencies.dtype) * frequencies).flatten(1)
    cosine, sine = angles.cos().float(), angles.sin().float()
    turn = torch.stack((torch.cat((cosine, cosine), dim=-1), torch.cat((-sine, sine), dim=-1)))  # [2, sum of S, E]
    parts = turn.split([length for _, length in plan.shots], dim=1)
    of_shots = [Run(*shot, *part) for shot, part in zip(plan.shots, parts, strict=True)]
    if plan.windows is None:
        return of_shots, of_shots
    of_patches = _moved(_repeated(turn.transpose(0, 1), plan.shots), plan.order)
    parts = of_patches.split([count * length for count, length in plan.windows])
    return of_shots, [
        Run(*run, *part.unflatten(0, run).unsqueeze(1).unbind(3)) for run, part in zip(plan.windows, parts, strict=True)
    ]


def _repeated(of_sizes: Tensor, shots: Runs) -> Tensor:
    """Repeat one shot's values for all shots with the same size: [sum of S, ...] -> [N, ...]."""
    parts = zip(of_sizes.split([length for _, length in shots]), shots, strict=True)
    return concatenated([part.repeat(count, *(1,) * (part.ndim - 1)) for part, (count, _) in parts])


def _moved(patches: Tensor, order: Tensor | None) -> Tensor:
    """Reorder patches by merged tokens: [N, ...] -> [N, ...]."""
    return patches.unflatten(0, (-1, UNIT))[order].flatten(0, 1)


@lru_cache(maxsize=256)
def _positions(rows: int, columns: int) -> Tensor:
    """Return the row and column of all patches in a shot, int64 [S, 2]."""
    indices = np.indices((rows, columns)).reshape(2, rows // MERGE, MERGE, columns // MERGE, MERGE)
    return torch.from_numpy(np.ascontiguousarray(indices.transpose(1, 3, 2, 4, 0).reshape(-1, 2)))


@lru_cache(maxsize=256)
def _corners(rows: int, columns: int, side: int) -> tuple[Tensor, Tensor]:
    """Return the 4 learned positions (of side x side) around each patch, int64 [4, S], and weights, float32 [4, S]."""
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
    """Return a shot's merged tokens by window, int64 [windows, tokens], keyed by tokens per window."""
    tokens = np.arange(rows * columns).reshape(rows, columns)
    found: dict[int, list[Indices]] = {}
    for top in range(0, rows, side):
        for left in range(0, columns, side):
            window = tokens[top : top + side, left : left + side].ravel()
            found.setdefault(len(window), []).append(window)
    return {length: np.stack(windows) for length, windows in found.items()}


def _windows(grids: Sequence[Grid], side: int) -> tuple[Runs, Indices]:
    """Return window runs (count, patches per window) and the merged tokens in window order, int64 [N / U]."""
    runs, order, start = [], [], 0
    for grid in grids:
        for length, windows in _windows_of(grid.rows // MERGE, grid.columns // MERGE, side).items():
            shots = start + np.arange(grid.groups) * grid.tokens_per_group
            order.append((shots[:, None, None] + windows).ravel())
            runs.append((grid.groups * len(windows), length * UNIT))
        start += grid.groups * grid.tokens_per_group
    return tuple(runs), np.concatenate(order)


ROOM = 16  # slots that KeyValues adds at a time


class KeyValues:
    """A ``Cache`` of all tokens so far, layer by layer.

    A conversation has S slots, filled from the first. After the pass over the prompts, call ``place`` before the pass
    over each further token.
    """

    def __init__(self) -> None:
        self._of_layers: dict[int, tuple[Tensor, Tensor]] = {}  # by layer: [B, S, heads, D / heads] twice
        self._next: Tensor | None = None  # int64 [B], the next tokens' slots among all B * S
        self._num_seen = 0

    def place(self, lengths: Tensor, longest: int) -> None:
        """Put the next token of each conversation behind its first ``lengths`` tokens, and forget later ones.

        lengths: int64 [B], how many tokens to keep
        longest: the maximum of ``lengths``
        """
        self._num_seen = longest + 1
        if self._num_seen > self._of_layers[0][0].shape[1]:
            for layer, (keys, values) in self._of_layers.items():
                self._of_layers[layer] = _with_room(keys), _with_room(values)
        num_slots = self._of_layers[0][0].shape[1]
        self._next = torch.arange(len(lengths), device=lengths.device) * num_slots + lengths

    def update(self, keys: Tensor, values: Tensor, layer: int) -> tuple[Tensor, Tensor]:
        """Add the keys and values of new tokens, [B, heads, L, D / heads], and return those of all tokens.

        Behind a conversation's own tokens, the result holds padding, forgotten tokens or zeros.
        """
        new = keys.transpose(1, 2), values.transpose(1, 2)
        if self._next is None:
            self._of_layers[layer] = _with_room(new[0]), _with_room(new[1])
            return keys, values
        kept = self._of_layers[layer]
        for slots, tokens in zip(kept, new, strict=True):
            slots.flatten(0, 1).index_copy_(0, self._next, tokens.flatten(0, 1))
        return kept[0][:, : self._num_seen].transpose(1, 2), kept[1][:, : self._num_seen].transpose(1, 2)


def _with_room(slots: Tensor) -> Tensor:
    """Return a copy with ROOM more slots: [B, S, heads, D / heads] -> [B, S + ROOM, heads, D / heads].

    The new slots are zeros: attention must not meet a NaN, even where a mask gives it no weight.
    """
    return F.pad(slots, (0, 0, 0, 0, 0, ROOM))


class Part:
    """Tokens that pass each layer together, and their current hidden states.

    language: transformers' language model
    inputs: on its device: input_ids, int64 [B, L]; position_ids, int64 [3, B, L]; with ``features`` also visual_tokens,
        int64 [M], the visual tokens' indices among all B * L, and visual_features, int64 [M], their indices in
        ``features``
    features: [N / U, levels, D], the merged tokens of all shots; None: there are no visual tokens
    cache: receives these tokens' keys and values; None: nothing is kept
    mask: returns which tokens each token sees; None: the earlier ones
    """

    def __init__(
        self,
        language: Any,
        inputs: dict[str, Tensor],
        features: Tensor | None = None,
        cache: Cache | None = None,
        mask: Callable[[], Tensor | None] = lambda: None,
    ) -> None:
        self._cache, self._mask, self._deeper = cache, mask, list[Tensor]()
        self.states = language.embed_tokens(inputs["input_ids"])
        if features is not None:
            self._at, self._picked = inputs["visual_tokens"], inputs["visual_features"]
            merged, *self._deeper = features.unbind(1)
            self.states.flatten(0, 1).index_copy_(0, self._at, merged[self._picked].to(self.states.dtype))
        self._turn = turn_of(language, self.states, inputs["position_ids"])

    def run(self, number: int, layer: DecoderLayer) -> None:
        """Run layer ``number`` on the tokens."""
        self.states = layer(self.states, self._turn, self._mask(), self._cache)
        if number < len(self._deeper):
            added = self._deeper[number][self._picked].to(self.states.dtype)
            self.states.flatten(0, 1).index_add_(0, self._at, added)


def run_layers(language: Any, *parts: Part) -> Tensor:
    """Run all layers on the parts in turn; return the states behind the final norm, [tokens, D]."""
    for number, layer in enumerate(decoder_layers(language)):
        for part in parts:
            part.run(number, layer)
    return language.norm(concatenated([part.states.flatten(0, 1) for part in parts]))


def next_hidden_state(
    language: Any, tokens: Indices, position_ids: Indices, lengths: Indices, key_values: KeyValues
) -> Tensor:
    """Return the hidden state of each conversation's next token behind the final norm, [B, D].

    tokens: int64 [B]
    position_ids: int64 [B], equal in time, row and column, since the token is text
    lengths: int64 [B], how many tokens precede
    key_values: holds the earlier tokens; receives this token and forgets all others
    """
    device = language.embed_tokens.weight.device
    ids, at, before = torch.from_numpy(np.stack([tokens, position_ids, lengths])).to(device)
    longest, is_seen = int(lengths.max()), None
    if int(lengths.min()) < longest:  # otherwise no mask: PyTorch's fastest attention takes none
        is_seen = (torch.arange(longest + 1, device=device) <= before[:, None])[:, None, None]
    key_values.place(before, longest)
    inputs = {"input_ids": ids[:, None], "position_ids": at[None, :, None].expand(3, -1, -1)}
    return run_layers(language, Part(language, inputs, None, key_values, lambda: is_seen))
