# SPDX-License-Identifier: MIT
"""The commands ``rfm-client gateway`` and ``rfm gateway``."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from rfm_client.contract.addresses import check_certificate, is_loopback
from rfm_client.contract.names import GATEWAY_KEY_VARIABLE
from rfm_client.transport.access import Access
from rfm_gateway.limits import Limits, with_limits

KEEP_ALIVE_S = 30
STOP_WITHIN_S = 30

logger = logging.getLogger("rfm_gateway")


@with_limits()
def gateway(
    triton: Annotated[
        str, typer.Option(help="grpc://host:port or http://host:port of Triton, with TLS grpcs:// or https://.")
    ],
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to listen on.")] = 8000,
    metrics_url: Annotated[
        str | None, typer.Option(help="Triton's metrics; else port 8002 of the same host.", show_default=False)
    ] = None,
    model: Annotated[str, typer.Option(help="Name under which the checkpoint was exported.")] = "rfm",
    api_key_file: Annotated[
        Path | None,
        typer.Option(
            help=f"File with the key that requests must show; else {GATEWAY_KEY_VARIABLE}.", show_default=False
        ),
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option(help="Serve HTTPS with this certificate (PEM), and its --key.", show_default=False)
    ] = None,
    key: Annotated[Path | None, typer.Option(help="The certificate's key (PEM).", show_default=False)] = None,
    triton_ca_file: Annotated[
        Path | None, typer.Option(help="Authorities (PEM) that Triton is trusted by; else the system's.")
    ] = None,
    triton_certificate: Annotated[Path | None, typer.Option(help="By which Triton knows the gateway (PEM).")] = None,
    triton_key: Annotated[Path | None, typer.Option(help="That certificate's key (PEM).")] = None,
    cors_origin: Annotated[
        list[str] | None, typer.Option(help="Origin from which browsers may ask. Again for more.", show_default=False)
    ] = None,
    allow_folder: Annotated[
        Path | None, typer.Option(help="Folder whose files requests may name.", show_default=False)
    ] = None,
    *,
    limits: Limits,
) -> None:
    """Serve the FastAPI evaluation server's endpoints before a Triton server."""
    try:
        import uvicorn

        from rfm_gateway.app import GatewaySettings, create_app
    except ModuleNotFoundError as error:
        raise typer.BadParameter(f"the gateway needs {error.name}: pip install ./client ./gateway") from None
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    api_key = _key(api_key_file)
    try:
        tls = _tls(certificate, key)
        settings = GatewaySettings(
            triton_url=triton,
            metrics_url=metrics_url,
            model=model,
            limits=limits,
            api_key=api_key,
            access=Access(triton_ca_file, triton_certificate, triton_key),
            cors_origins=tuple(cors_origin or ()),
            folder=allow_folder,
        )
        app = create_app(settings)
    except (ValueError, OSError) as error:
        raise typer.BadParameter(str(error)) from None
    if api_key is None and not is_loopback(host):
        logger.warning("%s is no loopback address, and no key is required: whoever reaches it may use it", host)
    uvicorn.run(
        app,
        host=host,
        port=port,
        access_log=False,
        log_config=None,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=STOP_WITHIN_S,
        **tls,
    )


def gateway_command(
    triton: str, metrics_url: str, model: str, host: str, port: int, *, limits: Limits | None = None
) -> list[str]:
    """A command line that serves a gateway as ``gateway`` does, in a process of its own."""
    options = {"triton": triton, "metrics-url": metrics_url, "model": model, "host": host, "port": port}
    options |= (limits or Limits()).options
    words = (word for name, value in options.items() for word in (f"--{name}", str(value)))
    return [sys.executable, "-m", "rfm_gateway", *words]


def _tls(certificate: Path | None, key: Path | None) -> dict[str, Any]:
    """Arguments of uvicorn. Raises ValueError for what it could not serve."""
    if certificate is None and key is None:
        return {}
    if certificate is None or key is None:
        raise ValueError("--certificate, --key: expected both or none, got one")
    check_certificate(certificate, key, "--certificate, --key")
    return {"ssl_certfile": certificate, "ssl_keyfile": key}


def _key(file: Path | None) -> str | None:
    try:
        key = os.environ.get(GATEWAY_KEY_VARIABLE) if file is None else file.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise typer.BadParameter(f"--api-key-file: expected a text file, got {error}") from None
    if key is not None and not key.strip():
        raise typer.BadParameter("key: expected at least one character, got none")
    return None if key is None else key.strip()
