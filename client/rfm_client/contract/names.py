# SPDX-License-Identifier: MIT
"""Names of models, requests and variables on which client and server agree."""

from __future__ import annotations

from typing import Literal, TypeAlias

Part: TypeAlias = Literal["embeddings", "encoder", "frames"]  # of a served checkpoint: a model each

DEFAULT_MODEL = "rfm"  # scores embeddings; the names of the others are made from it

PROBE_PREFIX = "rfm-probe"  # of the request ids of health probes; a model does not count those for a blank sample

ADMIN_KEY_VARIABLE = "RFM_ADMIN_KEY"
GATEWAY_KEY_VARIABLE = "RFM_GATEWAY_API_KEY"


def encoder_name(model: str) -> str:
    """Name of the model that turns frames into the embeddings that ``model`` scores."""
    return f"{model}_encoder"


def frames_name(model: str) -> str:
    """Name of the model that scores raw frames, beside ``model``, which scores embeddings."""
    return f"{model}_frames"
