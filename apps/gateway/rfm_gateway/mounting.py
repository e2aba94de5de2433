# SPDX-License-Identifier: MIT
"""What a page in the browser needs of the gateway that serves it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from rfm_client import AsyncRewardClient
from rfm_gateway.body import BodyLimits, Decoded, field_errors, invalid
from rfm_gateway.config import GatewayConfig
from rfm_gateway.observe import GatewayMetrics, while_connected
from rfm_gateway.pages import add_page

__all__ = [
    "BodyLimits",
    "Decoded",
    "GatewayConfig",
    "GatewayMetrics",
    "Surroundings",
    "add_page",
    "field_errors",
    "invalid",
    "while_connected",
]


@dataclass(frozen=True)
class Surroundings:
    """The gateway around a page.

    new_client: returns a client for a model's name
    max_decoded_bytes: limit of the decoded files of one request
    """

    config: GatewayConfig
    new_client: Callable[..., AsyncRewardClient]
    limits: BodyLimits
    max_decoded_bytes: int
    metrics: GatewayMetrics
