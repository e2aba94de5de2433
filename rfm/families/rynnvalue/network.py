# SPDX-License-Identifier: MIT
"""RynnValue's heads on a Qwen3-VL, and how their logits become seconds.

A group is a run of copies of one value token behind a frame; a head reads their hidden states side by side. G groups, R
copies per group, width D, K bins. Source: ``rynn_value`` in ``alibaba-damo-academy/RynnValue``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Literal, TypeAlias

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rfm.engine.graphs import Graphs
from rfm.qwen.batch import VlmBatch
from rfm.qwen.language import LanguageConfig
from rfm.qwen.network import qwen_states

Attention: TypeAlias = Literal["isolated", "causal"]
Transform: TypeAlias = Literal["symlog", "linear", "quantile"]
ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "relu": F.relu,
    "gelu": F.gelu,
    "silu": F.silu,
    "tanh": torch.tanh,
    "leaky_relu": F.leaky_relu,
}
_LEAST_PROBABILITY = 1e-8  # added before the logarithm of the entropy


@dataclass(frozen=True)
class Bins:
    """The seconds that a head's bins stand for.

    count: K
    transform: symlog and linear bins lie evenly, from ``least_s`` to ``most_s``; quantile bins between ``edges_s``
    edges_s: K + 1 edges for quantile bins; None: other bins
    """

    count: int
    transform: Transform
    least_s: float
    most_s: float
    edges_s: tuple[float, ...] | None = None

    @cached_property
    def centres(self) -> Tensor:
        """float32 [K]: seconds; for symlog bins, their symmetric logarithm."""
        if self.edges_s is not None:
            edges = torch.tensor(self.edges_s)
            return (edges[:-1] + edges[1:]) * 0.5
        ends = torch.tensor([self.least_s, self.most_s])
        if self.transform == "symlog":
            ends = ends.sign() * ends.abs().log1p()
        first, last = ends.tolist()
        return torch.linspace(first, last, self.count)

    def seconds(self, logits: Tensor) -> Tensor:
        """Return the expected seconds, float32: [..., K] -> [...]."""
        mean = (logits.float().softmax(-1) * self.centres.to(logits.device)).sum(-1)
        return mean.sign() * mean.abs().expm1() if self.transform == "symlog" else mean


def entropy(logits: Tensor) -> Tensor:
    """Return the entropy of the bin probabilities in nats, float32: [..., K] -> [...]."""
    probabilities = logits.float().softmax(-1)
    return -(probabilities * (probabilities + _LEAST_PROBABILITY).log()).sum(-1)


@dataclass(frozen=True)
class HeadConfig:
    """The layers in a head: one (``linear``), or ``depth`` residual blocks with width ``width`` (``bro``)."""

    kind: Literal["linear", "bro"]
    width: int
    depth: int
    activation: str


@dataclass(frozen=True)
class RynnConfig(LanguageConfig):
    """The configuration of a RynnValue model.

    attention: isolated: the tokens in a group see each other, and no other token sees them; causal: they are ordinary
        tokens
    value_token, relative_token: ids of the tokens behind a frame
    value_copies, relative_copies: R, copies per group
    num_heads: heads for the remaining seconds; their mean is the score
    use_meta: the prompt names the robot and the camera
    robot_description, camera_description: their words in the prompt; None: not named
    least_px, most_px: pixels per frame after resizing
    causal_mask: always True: no frame's value depends on later frames, so one pass scores every prefix
    """

    attention: Attention
    value_token: int
    relative_token: int
    value_copies: int
    relative_copies: int
    num_heads: int
    value_head: HeadConfig
    relative_head: HeadConfig
    value_bins: Bins
    relative_bins: Bins
    use_meta: bool
    least_px: int
    most_px: int
    robot_description: str | None = None
    camera_description: str | None = None
    causal_mask: Literal[True] = True

    reward_model: ClassVar[str] = "rynnvalue"
    multi_image: ClassVar[bool] = True

    @classmethod
    def fields_of(cls, settings: dict[str, Any]) -> dict[str, Any]:
        """Return this class's fields from an export's settings."""
        fields = {**settings}
        parts = {"value_head": HeadConfig, "relative_head": HeadConfig, "value_bins": Bins, "relative_bins": Bins}
        for name, made in parts.items():
            values = {key: tuple(each) if isinstance(each, list) else each for key, each in fields[name].items()}
            fields[name] = made(**values)
        for name in ("robot", "camera"):  # in exports from 0.4
            if name in fields:
                fields[f"{name}_description"] = fields.pop(name)
        return fields


class BroBlock(nn.Module):
    """A residual block in a ``bro`` head."""

    def __init__(self, config: HeadConfig) -> None:
        super().__init__()
        self.fc1, self.fc2 = (nn.Linear(config.width, config.width) for _ in range(2))
        self.ln1, self.ln2 = (nn.LayerNorm(config.width) for _ in range(2))
        self._activation = ACTIVATIONS[config.activation]

    def forward(self, x: Tensor) -> Tensor:
        """Float [G, width] -> [G, width]."""
        inner = self._activation(self.ln1(self.fc1(x)))
        added: Tensor = self.ln2(self.fc2(inner))
        return x + added


class BroHead(nn.Module):
    """A group's states -> logits, through residual blocks."""

    def __init__(self, config: HeadConfig, num_inputs: int, num_bins: int) -> None:
        super().__init__()
        self.input_layer = nn.Linear(num_inputs, config.width)
        self.input_norm = nn.LayerNorm(config.width)
        self.blocks = nn.ModuleList(BroBlock(config) for _ in range(config.depth))
        self.final_layer = nn.Linear(config.width, num_bins)
        self._activation = ACTIVATIONS[config.activation]

    def forward(self, states: Tensor) -> Tensor:
        """Float [G, R * D] -> [G, K]."""
        x = self._activation(self.input_norm(self.input_layer(states)))
        for block in self.blocks:
            x = block(x)
        logits: Tensor = self.final_layer(x)
        return logits


class ValueHead(nn.Module):
    """A head with the original's weight names."""

    def __init__(self, config: HeadConfig, num_inputs: int, num_bins: int) -> None:
        super().__init__()
        is_linear = config.kind == "linear"
        self.proj = nn.Linear(num_inputs, num_bins) if is_linear else BroHead(config, num_inputs, num_bins)

    def forward(self, states: Tensor) -> Tensor:
        """Float [G, R * D] -> [G, K]."""
        logits: Tensor = self.proj(states)
        return logits


@dataclass(frozen=True)
class RynnBatch(VlmBatch):
    """Conversations with G groups of value tokens and Q groups of relative value tokens.

    values, relatives: int64 [G] and [Q], the groups' first tokens as indices among all tokens in the batch: the
        conversations' B * L, then those in the packs
    """

    values: Tensor = field(kw_only=True)
    relatives: Tensor = field(kw_only=True)

    @classmethod
    def of(cls, batch: VlmBatch, relative_token: int, relative_copies: int) -> RynnBatch:
        """Return the batch whose spans hold, for each frame, its relative values (if any) and its values (if any)."""
        packs = [each.input_ids.flatten() for each in batch.packs]
        ids = torch.cat([batch.inputs["input_ids"].flatten(), *packs]).numpy()
        firsts, ends = batch.spans[batch.spans[:, 0] < batch.spans[:, 1]].numpy().T
        has_relative = ids[firsts] == relative_token
        behind = firsts + has_relative * relative_copies
        found = behind[behind < ends], firsts[has_relative]
        values, relatives = (torch.from_numpy(np.ascontiguousarray(each)) for each in found)
        return cls(**vars(batch), values=values, relatives=relatives)


@dataclass(frozen=True)
class RynnOutput:
    """A batch's logits: values, [heads, G, K], and relative values, [G, K].

    made: features from the vision tower, [merged tokens, levels, D]; None: all shots are cached
    """

    values: Tensor
    relatives: Tensor
    made: Tensor | None


class RynnNetwork(nn.Module):
    """The backbone and its heads."""

    graphs: Graphs | None = None

    def __init__(self, config: RynnConfig, backbone: nn.Module) -> None:
        super().__init__()
        self.config = config
        self.model: Any = backbone
        of_value = config.value_head, config.value_copies * config.hidden_dim, config.value_bins.count
        of_relative = config.relative_head, config.relative_copies * config.hidden_dim, config.relative_bins.count
        self.value_heads = nn.ModuleList(ValueHead(*of_value) for _ in range(config.num_heads))
        self.relative_value_head = ValueHead(*of_relative)

    def forward(self, batch: RynnBatch) -> RynnOutput:
        """Return the logits for every group in a batch on the network's device."""
        states, made = qwen_states(self.model, batch, graphs=self.graphs)
        values = _of_groups(states, batch.values, self.config.value_copies)
        relatives = _of_groups(states, batch.relatives, self.config.relative_copies)
        logits = torch.stack([head(values) for head in self.value_heads])
        return RynnOutput(logits, self.relative_value_head(relatives), made)


def _of_groups(states: Tensor, firsts: Tensor, copies: int) -> Tensor:
    """Return the groups' states side by side: [all tokens, D] -> [G, R * D]; ``firsts``: their first tokens."""
    return states[firsts[:, None] + torch.arange(copies, device=states.device)].flatten(1)
