# SPDX-License-Identifier: MIT
"""The smallest request that a model can answer, for probes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rfm_client.contract import ProgressSample, wire
from rfm_client.contract.samples import blank_trajectory


def probe_request(config: Mapping[str, Any]) -> wire.Tensors:
    """Return the inputs for one blank sample, for a model with this configuration."""
    dims = {tensor["name"]: [int(dim) for dim in tensor["dims"]] for tensor in config["input"]}
    widths = None
    if wire.VIDEO_EMBEDDINGS in dims:
        widths = dims[wire.VIDEO_EMBEDDINGS][-1], dims[wire.TEXT_EMBEDDING][-1]
    tensors = wire.encode_samples([ProgressSample(blank_trajectory(widths))])
    return {name: tensor for name, tensor in tensors.items() if name in dims}
