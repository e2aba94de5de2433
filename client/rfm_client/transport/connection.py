# SPDX-License-Identifier: MIT
"""A connection to a server, and when it is to be left because nothing comes over it any more.

A connection can die in silence: a firewall or a machine that is gone drops packets and says nothing. Over gRPC all
calls share one connection, so each of them would run into its deadline. Two rules end that:

- A request whose bytes the other machine does not acknowledge within UNACKNOWLEDGED_MS ends the connection. The kernel
  watches this (TCP_USER_TIMEOUT, which gRPC sets where keepalive is on). The call is sent again over a new connection.
- If a call runs into its deadline and nothing has come over the connection for SILENT_S, calls that follow get a new
  one. This covers peers that acknowledge bytes and do not answer, such as a proxy that hangs.

Pings alone cannot do it. Triton closes a connection for more than two pings that come less than 300 s apart while it
sends nothing, as during a long call. So gRPC pings every PING_MS at most, and only while a call is under way.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rfm_client.contract.proxies import grpc_proxy

PING_MS = 330_000
UNACKNOWLEDGED_MS = 10_000
SILENT_S = 1.0

_UNBOUNDED = -1
GRPC_OPTIONS: dict[str, int | str] = {
    "grpc.max_send_message_length": _UNBOUNDED,
    "grpc.max_receive_message_length": _UNBOUNDED,
    "grpc.lb_policy_name": "round_robin",  # over the addresses of a name; looked up again when a connection ends
    "grpc.initial_reconnect_backoff_ms": 100,
    "grpc.max_reconnect_backoff_ms": 2000,  # two minutes otherwise, when the server may long be back
    "grpc.keepalive_time_ms": PING_MS,
    "grpc.keepalive_timeout_ms": UNACKNOWLEDGED_MS,
    "grpc.use_local_subchannel_pool": 1,  # else a new channel would use the old one's connection
}


def grpc_options(address: str) -> list[tuple[str, int | str]]:
    """Options of a channel to ``host:port``."""
    options = GRPC_OPTIONS if grpc_proxy(address) else {**GRPC_OPTIONS, "grpc.enable_http_proxy": 0}
    return list(options.items())


class Connection:
    """One of tritonclient's asyncio clients, for one event loop. It closes itself when it is left and not used."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._num_calls = 0
        self._is_left = False
        self._silent_since_s: float | None = None  # since the first call that nothing has come after
        self._closing: asyncio.Task[None] | None = None

    @contextmanager
    def used(self) -> Iterator[Any]:
        """A context in which a call may use the client."""
        self._num_calls += 1
        if self._silent_since_s is None:
            self._silent_since_s = time.monotonic()
        try:
            yield self._client
        finally:
            self._num_calls -= 1
            self._close_if_unused()

    def record_answer(self) -> None:
        """Records that the server has just sent something."""
        self._silent_since_s = None

    @property
    def is_silent(self) -> bool:
        """Whether nothing has come for SILENT_S, although somebody waits."""
        return self._silent_since_s is not None and time.monotonic() - self._silent_since_s >= SILENT_S

    def leave(self) -> None:
        """No call that begins now will use it."""
        self._is_left = True
        self._close_if_unused()

    @property
    def is_closed(self) -> bool:
        """Whether nothing of it is left."""
        return self._closing is not None and self._closing.done()

    async def close(self) -> None:
        """Closes the connection, even if calls still use it."""
        if self._closing is None:
            self._closing = asyncio.create_task(self._client.close())
        await self._closing

    def _close_if_unused(self) -> None:
        if self._is_left and not self._num_calls and self._closing is None:
            self._closing = asyncio.create_task(self._client.close())
