# SPDX-License-Identifier: MIT
"""Tensors that go to the reference server as they are."""

from __future__ import annotations

import asyncio

from rfm_client.contract.wire import Tensors, encode_samples
from rfm_client.transport.calls import connect

__all__ = ["Tensors", "encode_samples", "infer"]


def infer(url: str, model: str, tensors: Tensors, outputs: list[str]) -> Tensors:
    """The tensors as they stand, right or wrong, in one request."""

    async def ask() -> Tensors:
        transport = connect(url)
        try:
            return (await transport.infer(model, tensors, outputs, timeout_s=30)).tensors
        finally:
            await transport.close()

    return asyncio.run(ask())
