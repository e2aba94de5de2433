# SPDX-License-Identifier: MIT
"""The commands ``rfm-client gateway`` and ``rfm gateway``."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from rfm_client.command_line import with_options
from rfm_client.options import ConfigError, setting
from rfm_client.serving import DEFAULT_MODEL, raise_limit, write_log
from rfm_gateway.config import DEFAULT_HOST, DEFAULT_PORT, MAX_PORT, GatewayConfig

KEEP_ALIVE_S = 30
MAX_HEAD_BYTES = 64 * 2**10  # for a request; also for its trailers
STOP_WITHIN_S = 30
logger = logging.getLogger("rfm_gateway")


@dataclass(frozen=True)
class GatewayOptions(GatewayConfig):
    """Settings of a gateway without ``rfm serve``."""

    port: int | None = setting(DEFAULT_PORT, "Port to listen on.", least=1, most=MAX_PORT)
    host: str | None = setting(DEFAULT_HOST, "Address to listen on.")
    triton: str | None = setting(..., "grpc://host:port or http://host:port of Triton, with TLS grpcs:// or https://.")
    metrics_url: str | None = setting(None, "URL of Triton's metrics. Default: port 8002 beside port 8000 or 8001.")
    model: str | None = setting(DEFAULT_MODEL, "Model name in the repository.")


@with_options
def gateway(config: GatewayOptions) -> None:
    """Serve the FastAPI server's endpoints before a Triton server.

    For a Triton that runs already. `rfm serve --gateway-port` starts Triton and gateway together, and restarts both.
    `rfm gateway` and `rfm-client gateway` are the same command; the second needs no PyTorch.

    Example: rfm-client gateway --triton grpc://localhost:8001 --port 8100
    """
    try:
        import uvicorn

        from rfm_gateway.app import create_app
        from rfm_gateway.mounting import INSTALL, page_of
    except ModuleNotFoundError as error:
        raise typer.BadParameter(f"the gateway needs {error.name}: pip install ./client ./apps/gateway") from None
    write_log("rfm-gateway", os.environ)
    address = config.address
    try:
        api_key, options = config.api_key(os.environ), server_options(config)
        app = create_app(config, api_key, _started_by(sys.argv[0]))
        address.check_free("gateway", port_option="--port")
    except ConfigError:  # with_options names the option
        raise
    except (ValueError, OSError) as error:
        raise typer.BadParameter(str(error)) from None
    if api_key is None and not address.is_loopback:
        open_to_all = "%s is no loopback address, and no key is required: every host that reaches it can use it"
        logger.warning(open_to_all, address.host)
    if api_key is None and config.triton_api_key_file is not None:
        logger.warning(
            "sends Triton's key on behalf of every caller, because it asks for no key itself: set --api-key-file"
        )
    logger.info("answers requests at %s", page_link(config))
    if page_of(config) is not None:
        logger.info("look at rewards in the browser: %s", page_link(config))
    elif config.viewer:
        logger.info("no page in the browser, since the package rfm-page is not installed: %s", INSTALL)
    uvicorn.run(app, **options)


def server_options(config: GatewayConfig) -> dict[str, Any]:
    """Return uvicorn's options, and let this process open as many files as it may. Raises ConfigError."""
    return {
        "host": config.address.host,
        "port": config.address.port,
        "access_log": False,
        "log_config": None,
        "log_level": "error",  # malformed requests are warnings, with which callers could fill the log
        "http": "h11",  # httptools loses the body behind `Upgrade: h2c`, which JDK clients and `curl --http2` send
        "ws": "none",
        "h11_max_incomplete_event_size": MAX_HEAD_BYTES,
        "limit_concurrency": raise_limit() * 7 // 8,  # the other descriptors are for files and for Triton
        "timeout_keep_alive": KEEP_ALIVE_S,
        "timeout_graceful_shutdown": STOP_WITHIN_S,
        **config.tls,
    }


def check_gateway(config: GatewayConfig, environment: Mapping[str, str]) -> None:
    """Raise ValueError or OSError for settings that would keep a gateway beside ``rfm serve`` from starting."""
    from rfm_gateway.app import create_app

    config.address.check_free("port", port_option="--gateway-port", host_option="--gateway-host")
    _ = config.tls
    create_app(config, config.api_key(environment))


def gateway_command(config: GatewayConfig) -> list[str]:
    """Return a command line that runs this gateway in another process."""
    words = []
    for name, each in GatewayConfig.settings().items():
        value = getattr(config, name)
        if isinstance(value, bool):
            if value or each.default:  # a switch that is off by default has no --no-
                words.append(each.option if value else each.negation)
            continue
        values = value if isinstance(value, tuple) else () if value is None else (value,)
        words += [word for value in values for word in (each.option, str(value))]
    return [sys.executable, "-m", "rfm_gateway", *words]


def _started_by(program: str) -> str:
    """Return the command that a person typed: this one, or ``rfm serve``, which runs ``python -m rfm_gateway``."""
    name = Path(program).name
    return f"{name} gateway" if name in ("rfm", "rfm-client") else "rfm serve"


def page_link(config: GatewayConfig) -> str:
    """Return the URL for the page and the endpoints, for callers that can reach the address."""
    return f"{config.address.url('http' if config.certificate is None else 'https')}/"
