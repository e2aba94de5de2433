# SPDX-License-Identifier: MIT
"""What the servers of one client say of their models, remembered until another version answers."""

from __future__ import annotations

import asyncio
import logging
import time

from rfm_client.contract.errors import ModelNotFoundError, RewardError
from rfm_client.contract.model_info import ModelInfo
from rfm_client.transport.deadline import Deadline
from rfm_client.transport.servers import Servers

REQUEST_TIMEOUT_S = 60.0  # of a request that nobody waits for
REST_S = 30.0  # before the next one, after one that failed

logger = logging.getLogger("rfm_client")


class ModelInfos:
    """Asks for what is not known yet, for one event loop."""

    def __init__(self, servers: Servers) -> None:
        self._servers = servers
        self._known: dict[str, ModelInfo] = {}
        self._requesting: asyncio.Task[None] | None = None
        self._rests_until_s = float("-inf")

    def known(self, model: str) -> ModelInfo | None:
        """What is known of ``model``; None: nothing is."""
        return self._known.get(model)

    async def get(self, model: str, deadline: Deadline, *, refresh: bool = False) -> ModelInfo:
        """What the server says of ``model``, requested once unless ``refresh``. Raises RewardError."""
        if refresh or model not in self._known:
            try:
                self._known[model] = await self._servers.model_info(model, deadline)
            except ModelNotFoundError:
                self._known.pop(model, None)
                raise
        return self._known[model]

    def request(self, model: str) -> None:
        """Has it requested, unless that is under way or has just failed. Nobody waits for it."""
        is_requesting = self._requesting is not None and not self._requesting.done()
        if not is_requesting and time.monotonic() >= self._rests_until_s:
            self._requesting = asyncio.create_task(self._request(model))

    def note_answer(self, model: str, version: str) -> None:
        """Forgets what is known of ``model`` if that is not about the version that has just answered."""
        known = self._known.get(model)
        if known is not None and known.versions and version not in known.versions:
            del self._known[model]

    def close(self) -> None:
        """Ends the request that nobody waits for."""
        if self._requesting is not None:
            self._requesting.cancel()

    async def _request(self, model: str) -> None:
        try:
            await self.get(model, Deadline(REQUEST_TIMEOUT_S))
        except RewardError as error:
            logger.info("%s: its configuration is not known: %s", model, error)
            self._rests_until_s = time.monotonic() + REST_S
