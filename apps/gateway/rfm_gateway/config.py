# SPDX-License-Identifier: MIT
"""Settings of a gateway: section ``gateway`` of ``rfm serve``'s YAML file, and options of ``rfm gateway``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

from rfm_client import AsyncRewardClient
from rfm_client.options import ConfigError, InvalidValueError, Settings, setting
from rfm_client.serving import (
    DEFAULT_MODEL,
    Credentials,
    ListenAddress,
    ServerStatus,
    check_certificate,
)

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8000
MIB = 2**20
KEY_VARIABLE = "RFM_GATEWAY_API_KEY"
MAX_PORT = 65535
_HOST_NAME = re.compile(r"[\w.-]+", re.ASCII)
_ORIGIN = re.compile(r"\*|[a-z][a-z0-9+.-]*://[^/A-Z]+")  # as browsers send it
_SHORTEST_S, _LONGEST_S = 0.001, 86_400.0  # a day


@dataclass(frozen=True)
class GatewayConfig(Settings):
    """Settings for a gateway: addresses, credentials, limits. docs/reference/gateway.md explains them.

    Addresses may be None, because ``rfm serve`` and ``rfm gateway`` have different defaults for them.
    """

    TITLE: ClassVar[str] = "Gateway"

    port: int | None = setting(None, "Port of the gateway. Default: no gateway.", least=1, most=MAX_PORT)
    host: str | None = setting(None, "Address of the gateway. Default: that of Triton.")
    triton: str | None = setting(
        None, "grpc://host:port or http://host:port of Triton, with TLS grpcs:// or https://; else the one beside it."
    )
    metrics_url: str | None = setting(None, "URL of Triton's metrics. Default: those of the Triton beside it.")
    model: str | None = setting(None, "Model name in the repository. Default: rfm, or export.name.")
    viewer: bool = setting(True, "Serve the page in the browser, at /.")
    dataset: tuple[str, ...] = setting(
        (), "Dataset to show on the page: a path, a Hub id, PATTERN=FOLDER or READER=FOLDER. Repeat for more."
    )
    api_key_file: Path | None = setting(None, f"File with the API key that requests need. Default: {KEY_VARIABLE}.")
    cors_origin: tuple[str, ...] = setting((), "Web origin that may send requests. Repeat for more.")
    allow_host: tuple[str, ...] = setting((), "Host name that callers without a key may use. Repeat for more.")
    timeout_s: float = setting(
        120.0,
        "Seconds for each stage of a request: arrival, wait, scoring.",
        least=_SHORTEST_S,
        most=_LONGEST_S,
        flag="--timeout",
    )
    max_body_mib: int = setting(512, "Largest request.", least=1)
    max_in_flight: int = setting(256, "Most evaluations at a time; others wait.", least=1)
    max_waiting: int = setting(1024, "Most waiting evaluations; others get 503.", least=0)
    use_frame_steps: bool = setting(False, "Turn use_frame_steps on for requests without this field.")
    refuse_blank: bool = setting(False, "Refuse black and single-colour frames instead of warning.")
    certificate: Path | None = setting(None, "Serve HTTPS with this certificate (PEM).")
    key: Path | None = setting(None, "The certificate's key (PEM).")
    triton_ca_file: Path | None = setting(None, "Certificate authorities (PEM) for Triton. Default: the system's.")
    triton_certificate: Path | None = setting(None, "Client certificate (PEM) for Triton.")
    triton_key: Path | None = setting(None, "That certificate's key (PEM).")
    triton_api_key_file: Path | None = setting(None, "File with the API key for Triton. Default: none.")

    def __post_init__(self) -> None:
        super().__post_init__()
        ConfigError.require_both(self, "certificate", "key")
        if self.metrics_url is not None and not self.metrics_url.startswith(("http://", "https://")):
            raise ConfigError.at("metrics_url", "http://host:port/metrics", repr(self.metrics_url))
        for name in self.allow_host:
            if not _HOST_NAME.fullmatch(name):
                raise ConfigError.at("allow_host", "a host name without scheme and port", repr(name))
        for origin in self.cors_origin:
            if not _ORIGIN.fullmatch(origin):
                expected = "* or an origin in lower case without a path, such as http://lab.example:3000"
                raise ConfigError.at("cors_origin", expected, repr(origin))

    @property
    def triton_url(self) -> str:
        """Triton's URL. Raises ConfigError if there is none."""
        if self.triton is None:
            raise ConfigError.at("triton", "the URL of a Triton", "none")
        return self.triton

    @cached_property
    def credentials(self) -> Credentials:
        """Credentials for Triton. Raises ConfigError for unusable files."""
        key = self._key_in("triton_api_key_file")
        try:
            return Credentials(self.triton_ca_file, self.triton_certificate, self.triton_key, api_key=key)
        except ConfigError as error:
            names = {"api_key": "api_key_file"}
            raise error.named(lambda name: f"triton_{names.get(name, name.removeprefix('client_'))}") from None

    @property
    def address(self) -> ListenAddress:
        """Address that the gateway listens on."""
        return ListenAddress(self.host or DEFAULT_HOST, self.port or DEFAULT_PORT)

    @property
    def checkpoint(self) -> str:
        """Model name in the repository."""
        return self.model or DEFAULT_MODEL

    def client(self, checkpoint: str | None = None) -> AsyncRewardClient:
        """Return a client for Triton. Raises ValueError for a malformed URL or unusable files.

        checkpoint: name of another export, which gets no shared memory: it would not pay for a few calls; None: the
            gateway's
        """
        host = self.triton_url.partition("://")[2].rpartition(":")[0].strip("[]")
        try:
            return AsyncRewardClient(
                self.triton_url,
                model=checkpoint or self.checkpoint,
                timeout_s=self.timeout_s,
                retry=False,  # the caller gets the error at once, and may retry
                max_in_flight=self.max_in_flight,
                shared_memory=checkpoint is None and ListenAddress(host, 0).is_loopback,
                **self.credentials.options,
            )
        except InvalidValueError as error:
            raise ConfigError.like(error, where="triton") if error.where == "url" else error from None

    async def status(self, timeout_s: float) -> ServerStatus:
        """Read the state of Triton and the devices. Raises ServerError."""
        # not asyncio.run in a thread: gRPC would keep an event loop for each call
        return await ServerStatus.read_async(
            self.triton_url,
            metrics_url=self.metrics_url,
            timeout_s=timeout_s,
            credentials=self.credentials,
        )

    @property
    def tls(self) -> dict[str, Any]:
        """TLS arguments for uvicorn. Raises ConfigError for unusable files."""
        if self.certificate is None or self.key is None:
            return {}
        check_certificate(self.certificate, self.key, "certificate")
        return {"ssl_certfile": self.certificate, "ssl_keyfile": self.key}

    def api_key(self, environment: Mapping[str, str]) -> str | None:
        """Return the key that requests must show, or None. Raises ConfigError."""
        key = environment.get(KEY_VARIABLE) if self.api_key_file is None else self._key_in("api_key_file")
        if key is not None and not key.strip():
            raise ConfigError.at("api_key_file", f"a key, here or in {KEY_VARIABLE}", "no character")
        return None if key is None else key.strip()

    def _key_in(self, name: str) -> str | None:
        """Return the key in a setting's file; None: no file. Raises ConfigError."""
        file: Path | None = getattr(self, name)
        try:
            return None if file is None else file.read_text().strip()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError.at(name, "a text file", error) from None
