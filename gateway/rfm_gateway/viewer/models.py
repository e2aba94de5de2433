# SPDX-License-Identifier: MIT
"""The models that the page may choose from, and a client for each."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable

from rfm_client.async_client import AsyncRewardClient
from rfm_client.contract.errors import ModelNotFoundError, RewardError
from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.names import frames_name
from rfm_client.transport.status import ModelStatus

_FRAMES_ENDING = frames_name("")


class Models:
    """A client for each model that somebody has asked about.

    new_client: makes one for the model of a name
    """

    def __init__(self, new_client: Callable[[str], AsyncRewardClient]) -> None:
        self._new_client = new_client
        self._clients: dict[str, AsyncRewardClient] = {}

    async def client(self, name: str, timeout_s: float) -> tuple[AsyncRewardClient, ModelInfo]:
        """A client of the model, and what is served of it for raw frames. Raises RewardError if it is not served."""
        client = self._clients.get(name) or self._new_client(name)
        try:
            info = await client.model_info(frames=True, timeout_s=timeout_s)
        except RewardError:
            if self._clients.get(name) is not client:  # names that nobody serves must not pile up
                await client.close()
            raise
        kept = self._clients.setdefault(name, client)
        if kept is not client:  # somebody else was quicker
            await client.close()
        return kept, info

    async def infos(self, names: Iterable[str], timeout_s: float) -> list[tuple[str, ModelInfo]]:
        """What is served for raw frames under these names. Raises RewardError."""
        return [found for found in await asyncio.gather(*(self._info(name, timeout_s) for name in names)) if found]

    async def aclose(self) -> None:
        """Closes the clients and their connections."""
        await asyncio.gather(*(client.close() for client in self._clients.values()))

    async def _info(self, name: str, timeout_s: float) -> tuple[str, ModelInfo] | None:
        try:
            return name, (await self.client(name, timeout_s))[1]
        except ModelNotFoundError:  # unloaded since it was listed
            return None


def names_of(served: Iterable[ModelStatus]) -> list[str]:
    """The names under which checkpoints were exported that score raw frames now."""
    names = {model.name for model in served if model.state == "READY" and model.name.endswith(_FRAMES_ENDING)}
    return sorted(name.removesuffix(_FRAMES_ENDING) for name in names)
