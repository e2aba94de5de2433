# SPDX-License-Identifier: MIT
"""Bound the evaluations at a time, and with them the bodies in memory."""

from __future__ import annotations

from collections.abc import AsyncGenerator

import anyio
from fastapi import HTTPException

from rfm_gateway.config import GatewayConfig
from rfm_gateway.observe import GatewayMetrics

RETRY_AFTER = {"Retry-After": "1"}


class Places:
    """Places for evaluations: ``max_in_flight`` at a time; ``max_waiting`` more wait, first come, first served."""

    def __init__(self, config: GatewayConfig, metrics: GatewayMetrics) -> None:
        self._config = config
        self._places = anyio.CapacityLimiter(config.max_in_flight)
        metrics.in_flight.set_function(lambda: self._places.borrowed_tokens)
        metrics.waiting.set_function(lambda: self._places.statistics().tasks_waiting)

    async def taken(self) -> AsyncGenerator[None, None]:
        """Dependency of endpoints: take a place before the body is read, and give it back after the answer.

        Raises HTTPException 503 if too many wait, or no place is free within ``timeout_s``.
        """
        detail = f"expected at most {self._config.max_in_flight} evaluations at a time, got more"
        full, places, request = HTTPException(503, detail, RETRY_AFTER), self._places, object()
        if places.available_tokens < 1 and places.statistics().tasks_waiting >= self._config.max_waiting:
            raise full
        with anyio.move_on_after(self._config.timeout_s) as waiting:
            await places.acquire_on_behalf_of(request)
        if waiting.cancelled_caught:
            raise full
        try:
            yield
        finally:
            places.release_on_behalf_of(request)
