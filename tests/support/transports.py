# SPDX-License-Identifier: MIT
"""Parts of a client's ``transports`` for stand-ins."""

from __future__ import annotations

from typing import Any

from rfm_client.contract.wire import Tensors
from rfm_client.transport.calls import Answer, TritonTransport

__all__ = ["Answer", "Recording", "Tensors"]


class Recording(TritonTransport):
    """Keeps the inputs and the id of each request."""

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self.requests: list[Tensors] = []
        self.request_ids: list[str] = []

    async def infer(self, model: str, inputs: Tensors, outputs: Any, timeout_s: float, **more: str) -> Answer:
        self.requests.append(inputs)
        self.request_ids.append(more.get("request_id", ""))
        return await super().infer(model, inputs, outputs, timeout_s, **more)
