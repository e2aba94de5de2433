# SPDX-License-Identifier: MIT
"""The two parts of a Qwen backbone's pass that become CUDA graphs: the vision tower and the language model.

Both depend on tensors and on the constants of the plan alone, and wait for nothing on the host.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from rfm.engine.graphs import Graphs
from rfm.vlm.qwen import UNIT, VisionPlan, features, last_hidden_state

LANGUAGE_INPUTS = ("input_ids", "position_ids", "visual_tokens", "visual_features")


def graphed_features(graphs: Graphs, visual: Any, patches: Tensor, plan: VisionPlan) -> Tensor:
    """Return ``rfm.vlm.qwen.features``, computed by a CUDA graph if the shapes recur."""
    of_plan = [value for value in vars(plan).values() if isinstance(value, Tensor)]

    def vision(patches: Tensor, *parts: Tensor) -> Tensor:
        left = iter(parts)
        return features(visual, patches, plan.changed(lambda _: next(left)))

    return graphs(vision, [patches, *of_plan], ("vision", plan.shots, plan.windows), len(patches) // UNIT)


def graphed_hidden_state(graphs: Graphs, language: Any, inputs: dict[str, Tensor], features: Tensor) -> Tensor:
    """Return ``rfm.vlm.qwen.last_hidden_state``, computed by a CUDA graph if the shapes recur."""

    def hidden_state(features: Tensor, *of_batch: Tensor) -> Tensor:
        return last_hidden_state(language, dict(zip(LANGUAGE_INPUTS, of_batch, strict=True)), features)

    tensors = [features, *(inputs[name] for name in LANGUAGE_INPUTS)]
    return graphs(hidden_state, tensors, "language", inputs["input_ids"].numel())
