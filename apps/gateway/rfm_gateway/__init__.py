# SPDX-License-Identifier: MIT
"""The FastAPI evaluation server's HTTP endpoints, in front of a Triton server.

``body`` and ``schema`` turn a request into samples, ``scoring`` scores them through ``AsyncRewardClient`` and writes
the response in the evaluation server's format, ``app`` joins the endpoints. The gateway holds no model and no queue.
"""

from rfm_gateway.command import check_gateway, gateway, gateway_command
from rfm_gateway.config import GatewayConfig

__all__ = ["GatewayConfig", "check_gateway", "gateway", "gateway_command"]
