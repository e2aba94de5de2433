# SPDX-License-Identifier: MIT
"""Names of models, requests and environment variables that client and server share."""

from __future__ import annotations

from typing import Literal, TypeAlias

Part: TypeAlias = Literal["embeddings", "encoder", "frames"]  # models of a served checkpoint

DEFAULT_MODEL = "rfm"  # scores embeddings; the names of the other models derive from it

PROBE_PREFIX = "rfm-probe"  # of the request ids of probes, which a model's metrics leave out

ADMIN_KEY_VARIABLE = "RFM_ADMIN_KEY"


def encoder_name(model: str) -> str:
    """Return the name of the encoder whose embeddings ``model`` scores."""
    return f"{model}_encoder"


def frames_name(model: str) -> str:
    """Return the name of the model that scores raw frames, beside ``model`` for embeddings."""
    return f"{model}_frames"
