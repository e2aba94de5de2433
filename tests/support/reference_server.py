# SPDX-License-Identifier: MIT
"""The server of all reference checkpoints, which the fixture ``served`` starts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rfm.launch.triton_server import Endpoints, TritonServer
from rfm_client import RewardClient


@dataclass(frozen=True)
class Served:
    """A running server with every reference checkpoint under its own name."""

    server: TritonServer

    @property
    def repository(self) -> Path:
        return self.server.repository

    @property
    def endpoints(self) -> Endpoints:
        return self.server.endpoints

    def url(self, protocol: str) -> str:
        return self.endpoints.grpc_url if protocol == "grpc" else self.endpoints.http_url

    def client(self, protocol: str, model: str = "c1_t1_disc10") -> RewardClient:
        return RewardClient(self.url(protocol), model=model)

    def revive(self) -> None:
        """Starts the server again if it has crashed, as ``rfm serve`` would: Triton 2.51 does, once in thousands of
        calls that are cancelled over gRPC (triton-inference-server/server, issue 7368), and takes no other test along.
        """
        if self.server.exit_status is not None:
            self.server.stop()
            self.server.start_ready()
