# SPDX-License-Identifier: MIT
"""The commands ``rfm-client gateway`` and ``rfm gateway``."""

from __future__ import annotations

import logging
import os
import sys
from typing import Annotated

import typer

from rfm_client.command_line import OptionsOf, with_options
from rfm_client.options import ConfigError, settings_of
from rfm_client.serving import DEFAULT_MODEL, check_free, from_here, in_url, is_loopback, raise_limit, write_log
from rfm_gateway.config import GatewayConfig
from rfm_gateway.installed_page import page_of

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8000
KEEP_ALIVE_S = 30
STOP_WITHIN_S = 30
OPTIONS = OptionsOf(
    GatewayConfig,
    required=("triton",),
    defaults={"host": DEFAULT_HOST, "port": DEFAULT_PORT, "model": DEFAULT_MODEL},
    helps={
        "host": "Address to listen on.",
        "port": "Port to listen on.",
        "triton": "grpc://host:port or http://host:port of Triton, with TLS grpcs:// or https://.",
        "metrics_url": "Triton's metrics; else port 8002 of the same host.",
        "model": "Name under which the checkpoint was exported.",
    },
    title="Gateway",
)

logger = logging.getLogger("rfm_gateway")


@with_options
def gateway(config: Annotated[GatewayConfig, OPTIONS]) -> None:
    """Serve the FastAPI server's endpoints before a Triton server.

    For a Triton that runs already. `rfm serve --gateway-port` starts Triton and gateway together, and restarts both.
    `rfm gateway` and `rfm-client gateway` are the same command; the second needs no PyTorch.
    """
    try:
        import uvicorn

        from rfm_gateway.app import create_app
        from rfm_gateway.connections import Connection, most_connections
    except ModuleNotFoundError as error:
        raise typer.BadParameter(f"the gateway needs {error.name}: pip install ./client ./apps/gateway") from None
    write_log("rfm-gateway", os.environ)
    host, port = config.host or DEFAULT_HOST, config.port or DEFAULT_PORT
    try:
        api_key, tls = config.api_key(os.environ), config.tls
        app = create_app(config, api_key)
        check_free(host, port, "gateway", port_option="--port")
    except ConfigError:  # with_options names its option
        raise
    except (ValueError, OSError) as error:
        raise typer.BadParameter(str(error)) from None
    if api_key is None and not is_loopback(host):
        logger.warning("%s is no loopback address, and no key is required: every host that reaches it can use it", host)
    if page_of(config) is not None:
        logger.info("look at rewards in the browser: %s", page_link(config))
    uvicorn.run(
        app,
        host=host,
        port=port,
        access_log=False,
        log_config=None,
        http=Connection,
        limit_concurrency=most_connections(raise_limit()),
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=STOP_WITHIN_S,
        **tls,
    )


def gateway_command(config: GatewayConfig) -> list[str]:
    """Return a command line that runs this gateway in another process."""
    words = []
    for name, each in settings_of(GatewayConfig).items():
        value = getattr(config, name)
        if isinstance(value, bool):
            words.append(each.option if value else each.option.replace("--", "--no-", 1))
            continue
        values = value if isinstance(value, tuple) else () if value is None else (value,)
        words += [word for value in values for word in (each.option, str(value))]
    return [sys.executable, "-m", "rfm_gateway", *words]


def page_link(config: GatewayConfig) -> str:
    """Return the page's URL for browsers that can reach the address."""
    host = config.host or DEFAULT_HOST
    scheme = "http" if config.certificate is None else "https"
    return f"{scheme}://{in_url(from_here(host))}:{config.port or DEFAULT_PORT}/"
