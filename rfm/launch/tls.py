# SPDX-License-Identifier: MIT
"""TLS of Triton's gRPC port. ``rfm serve`` itself asks Triton over HTTP, which then listens on 127.0.0.1 alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rfm.config import ServeConfig
from rfm.launch.installation import ServerStartError
from rfm_client.contract.addresses import check_authorities, check_certificate


@dataclass(frozen=True)
class GrpcTls:
    """Files (PEM) that Triton serves gRPC with. client_ca: who may vouch for clients, which then need a certificate"""

    certificate: Path
    key: Path
    client_ca: Path | None = None

    @classmethod
    def of(cls, config: ServeConfig) -> GrpcTls | None:
        """The files that the configuration names; None: gRPC is served without TLS."""
        if config.grpc_certificate is None or config.grpc_key is None:
            return None
        return cls(config.grpc_certificate, config.grpc_key, config.grpc_client_ca)

    def check(self) -> None:
        """Raises ServerStartError for files that Triton could not serve with."""
        try:
            check_certificate(self.certificate, self.key, "grpc_certificate, grpc_key")
            if self.client_ca is not None:
                check_authorities(self.client_ca, "grpc_client_ca")
        except ValueError as error:
            raise ServerStartError(str(error)) from None

    def arguments(self) -> list[str]:
        """Arguments of tritonserver that encrypt its gRPC port."""
        files = [f"--grpc-server-cert={self.certificate}", f"--grpc-server-key={self.key}"]
        if self.client_ca is None:
            return ["--grpc-use-ssl=true", *files]
        return ["--grpc-use-ssl-mutual=true", *files, f"--grpc-root-cert={self.client_ca}"]
