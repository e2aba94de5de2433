# SPDX-License-Identifier: MIT
"""Tensors that go to the reference server as they are."""

from __future__ import annotations

import asyncio

from rfm_client.contract import wire
from rfm_client.transport.calls import connect

TOLERANCE = 1e-5


def infer(url: str, model: str, tensors: wire.Tensors, outputs: list[str]) -> wire.Tensors:
    """The tensors as they stand, right or wrong, in one request."""

    async def ask() -> wire.Tensors:
        transport = connect(url)
        try:
            return (await transport.infer(model, tensors, outputs, timeout_s=30)).tensors
        finally:
            await transport.close()

    return asyncio.run(ask())
