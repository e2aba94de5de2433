# SPDX-License-Identifier: MIT
"""The options of both clients, declared once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path

from rfm_client.contract.wire import DEFAULT_MODEL
from rfm_client.transport.calls import Transport

DEFAULT_TIMEOUT_S = 60.0
DEFAULT_IN_FLIGHT = 128  # twice the usual batch: the next gathers while a batch is scored


@dataclass(eq=False, repr=False)
class ClientOptions:
    """Options of RewardClient and AsyncRewardClient, which do not change later.

    urls: one or several ``grpc://host:8001`` or ``http://host:8000``, with TLS ``grpcs://`` or ``https://``. The least
        busy server gets the next request; an episode stays on one server, which keeps frame features. A server is left
        out after a failure until it is ready again
    model: name used at export; raw frames go to ``<model>_frames``
    timeout_s: time limit for a call with all retries; at most 1e9
    retry: True: within the time limit, retry requests while a server is down, restarting or full
    max_in_flight: open requests at a time, with at most 256 MiB together; further requests wait
    shared_memory: True: large inputs go through shared memory, if client and server run on one host
    ca_file: certificate authorities (PEM) to trust; None: the system's, over gRPC its built-in list
    client_certificate, client_key: files (PEM) to identify this client (mutual TLS); both or neither
    headers: sent with each request, over gRPC as metadata
    api_key: sent with each request as ``Authorization: Bearer KEY``
    transports: used in place of connections to ``urls``, for tests and unusual networks

    Raises ValueError.
    """

    urls: str | Iterable[str]
    _: KW_ONLY
    model: str = DEFAULT_MODEL
    timeout_s: float = DEFAULT_TIMEOUT_S
    retry: bool = True
    max_in_flight: int = DEFAULT_IN_FLIGHT
    shared_memory: bool = False
    ca_file: str | Path | None = None
    client_certificate: str | Path | None = None
    client_key: str | Path | None = None
    headers: Mapping[str, str] | None = None
    api_key: str | None = None
    transports: Sequence[Transport] | None = None

    def __post_init__(self) -> None:
        """Make the client of these options."""
        raise NotImplementedError


ClientOptions.__init__.__doc__ = ClientOptions.__doc__  # so that help() of the clients shows it
