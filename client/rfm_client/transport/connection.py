# SPDX-License-Identifier: MIT
"""A connection to a server, and the rules by which a silent connection is replaced.

A firewall or a lost machine drops packets without an error. Over gRPC all calls share one connection, so each call
would run into its deadline. Two rules prevent that:

- A request whose bytes the peer does not acknowledge within UNACKNOWLEDGED_MS ends the connection. The kernel enforces
  this (TCP_USER_TIMEOUT, which gRPC sets where keepalive is on). The call is sent again over a new connection.
- If a call runs into its deadline and nothing has come over the connection for SILENT_S, later calls get a new
  connection. This covers peers that acknowledge bytes but do not answer, such as a proxy that hangs.

Pings alone do not suffice. Triton closes a connection after more than two pings less than 300 s apart during which it
sends nothing, as in a long call. So gRPC pings every PING_MS at most, and only during a call.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rfm_client.contract.addresses import grpc_proxy

PING_MS = 330_000
UNACKNOWLEDGED_MS = 10_000
SILENT_S = 1.0

_UNBOUNDED = -1
GRPC_OPTIONS: dict[str, int | str] = {
    "grpc.max_send_message_length": _UNBOUNDED,
    "grpc.max_receive_message_length": _UNBOUNDED,
    "grpc.lb_policy_name": "round_robin",  # over a name's addresses, looked up again when a connection ends
    "grpc.initial_reconnect_backoff_ms": 100,
    "grpc.max_reconnect_backoff_ms": 2000,  # default: two minutes, long after a restart
    "grpc.keepalive_time_ms": PING_MS,
    "grpc.keepalive_timeout_ms": UNACKNOWLEDGED_MS,
    "grpc.use_local_subchannel_pool": 1,  # else a new channel uses the old channel's connection
}


def grpc_options(address: str) -> list[tuple[str, int | str]]:
    """Return the options of a gRPC channel to ``host:port``."""
    options = GRPC_OPTIONS if grpc_proxy(address) else {**GRPC_OPTIONS, "grpc.enable_http_proxy": 0}
    return list(options.items())


class Connection:
    """A tritonclient asyncio client, for one event loop. Once left, it closes after its last call."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._num_calls = 0
        self._is_left = False
        self._silent_since_s: float | None = None  # first call since the last answer
        self._closing: asyncio.Task[None] | None = None

    @contextmanager
    def used(self) -> Iterator[Any]:
        """Context manager in which a call uses the client."""
        self._num_calls += 1
        if self._silent_since_s is None:
            self._silent_since_s = time.monotonic()
        try:
            yield self._client
        finally:
            self._num_calls -= 1
            self._close_if_unused()

    def record_answer(self) -> None:
        """Record that the server has just sent something."""
        self._silent_since_s = None

    @property
    def is_silent(self) -> bool:
        """True if nothing has come for SILENT_S since a call began."""
        return self._silent_since_s is not None and time.monotonic() - self._silent_since_s >= SILENT_S

    def leave(self) -> None:
        """Close the connection after its last call; no new call may use it."""
        self._is_left = True
        self._close_if_unused()

    @property
    def is_closed(self) -> bool:
        """True once ``close`` has finished."""
        return self._closing is not None and self._closing.done()

    async def close(self) -> None:
        """Close the connection, even if calls still use it."""
        if self._closing is None:
            self._closing = asyncio.create_task(self._client.close())
        await self._closing

    def _close_if_unused(self) -> None:
        if self._is_left and not self._num_calls and self._closing is None:
            self._closing = asyncio.create_task(self._client.close())
