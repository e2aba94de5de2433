# SPDX-License-Identifier: MIT
"""Parts of a client's ``transports`` for stand-ins."""

from __future__ import annotations

from typing import Any

from rfm_client.contract.wire import Tensors
from rfm_client.serving import Credentials
from rfm_client.transport.calls import Answer, GrpcTransport

__all__ = ["Answer", "Connection", "Recording", "Tensors"]


class Connection(GrpcTransport):
    """A gRPC connection to a real server, for tests to extend."""

    def __init__(self, url: str) -> None:
        super().__init__(url, Credentials(), shared_memory=False)


class Recording(Connection):
    """Keeps the inputs of each request."""

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self.requests: list[Tensors] = []

    async def infer(self, model: str, inputs: Tensors, outputs: Any, timeout_s: float, **more: str) -> Answer:
        self.requests.append(inputs)
        return await super().infer(model, inputs, outputs, timeout_s, **more)
