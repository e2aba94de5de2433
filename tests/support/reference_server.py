# SPDX-License-Identifier: MIT
"""The server of all reference checkpoints, which the fixture ``served`` starts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rfm.launch.process import Endpoints
from rfm_client import RewardClient


@dataclass(frozen=True)
class Served:
    """A running server with every reference checkpoint under its own name."""

    repository: Path
    endpoints: Endpoints

    def url(self, protocol: str) -> str:
        return self.endpoints.grpc_url if protocol == "grpc" else self.endpoints.http_url

    def client(self, protocol: str, model: str = "c1_t1_disc10") -> RewardClient:
        return RewardClient(self.url(protocol), model=model)
