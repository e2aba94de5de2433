# SPDX-License-Identifier: MIT
"""Servers with one checkpoint, and the retry loop for a request.

The least busy server gets a request, unless the caller names the one to ask first. A server that fails is left out
until it reports ready; the more often it has failed, the later it is asked. A score depends on the request alone, so a
request may be sent twice:

- the server is down, restarting or full: retry at once on another server, else after growing pauses
- a process or the connection ended, perhaps because of this request: retry once, when a server can be back. So a
  request ends at most two processes
- a model that answered before is missing: the server restarts or loads another version, so it counts as down
- the server denies access, fails, or lacks a model that never answered: try each other server once
- the sample is at fault, or the time is up: do not retry
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import math
import random
import time
from collections.abc import Awaitable, Callable, Collection, Sequence
from typing import TypeVar

from rfm_client.contract.addresses import with_proxy
from rfm_client.contract.checks import require
from rfm_client.contract.description import ModelInfo
from rfm_client.contract.errors import (
    AccessDeniedError,
    ClientClosedError,
    DeadlineExceededError,
    InferenceFailedError,
    ModelNotFoundError,
    ProcessEndedError,
    RewardError,
    ServerUnavailableError,
    clear_variables,
)
from rfm_client.contract.wire import Tensors
from rfm_client.transport.calls import Answer, Transport
from rfm_client.transport.limits import Deadline

Answered = TypeVar("Answered")
Request = Callable[[Transport, float], Awaitable[Answered]]

FIRST_PAUSE_S = 0.1
LONGEST_PAUSE_S = 2.0
LONGEST_REST_S = 30.0  # longest pause before probing a server that reports ready but keeps failing
RESTART_S = 15.0  # longer than `rfm serve` takes to notice that a process ended and to restart Triton
SPREAD_S = 1.0  # spreads retries, so that a request that ends its process again takes few others with it
PROBE_TIMEOUT_S = 2.0
LULL_S = 1.0  # no server restarts faster
_POLL_S = 0.2

logger = logging.getLogger("rfm_client")


class KnownServer:
    """One of several servers: transport, load, failures and descriptions.

    failures: how often the server was left out since the last success
    answered_at_s: when it last answered (monotonic clock)
    lost_at_s: when the first request that is retried failed (monotonic clock); None: none since the last success
    comeback: ends when the server reports ready again; None: never left out
    infos: its last descriptions, by model
    described: models described since it may have restarted, which a failure or a lull shows
    describing: held while an answer waits for a description
    """

    def __init__(self, transport: Transport) -> None:
        self.transport = transport
        self.outstanding = 0
        self.last_request = 0
        self.failures = 0
        self.answered_at_s = math.inf
        self.lost_at_s: float | None = None
        self.comeback: asyncio.Task[None] | None = None
        self.infos: dict[str, ModelInfo] = {}
        self.described: set[str] = set()
        self.describing = asyncio.Lock()

    @property
    def is_left_out(self) -> bool:
        """True if the server gets no requests until it reports ready."""
        return self.comeback is not None and not self.comeback.done()

    async def answer(self, request: Request[Answered], moment: int, left_s: float) -> Answered:
        """Return the server's answer. moment: request number, which breaks ties between servers."""
        self.outstanding += 1
        self.last_request = moment
        try:
            return await request(self.transport, left_s)
        finally:
            self.outstanding -= 1

    async def back(self, model: str, rest_s: float, restart_s: float) -> None:
        """Wait for ``rest_s``, then until the server is ready: after ``restart_s``, or after it reported not ready."""
        await asyncio.sleep(rest_s)
        until_s = time.monotonic() + restart_s
        for attempt in itertools.count():
            is_ready = await self.transport.is_ready(model, PROBE_TIMEOUT_S)
            if is_ready and time.monotonic() >= until_s:
                return
            until_s = until_s if is_ready else 0.0
            await asyncio.sleep(pause_s(attempt, LONGEST_PAUSE_S if rest_s else _POLL_S))

    async def close(self) -> None:
        """Close the connection, even if calls still use it."""
        if self.comeback is not None:
            self.comeback.cancel()
        await self.transport.close()


class Servers:
    """Several servers that share the requests, for one event loop. retry: True: send failed requests again."""

    def __init__(self, transports: Sequence[Transport], *, retry: bool) -> None:
        require("url", len(transports) > 0, "at least one", "none")
        self._servers = [KnownServer(transport) for transport in transports]
        self._retry = retry
        self._is_closed = False
        self._answered: set[str] = set()  # models that any server has served
        self._moments = itertools.count(1)

    def __len__(self) -> int:
        return len(self._servers)

    def __str__(self) -> str:
        return ", ".join(server.transport.url for server in self._servers)

    @property
    def first(self) -> Transport:
        """The first server, for a single request."""
        return self._servers[0].transport

    async def infer(
        self,
        model: str,
        inputs: Tensors,
        outputs: Collection[str],
        deadline: Deadline,
        *,
        request_id: str,
        first: int | None = None,
    ) -> tuple[Answer, KnownServer]:
        """Return the named ``outputs`` that ``model`` gives for ``inputs``, and who answered. Raises RewardError.

        first: index of the server to ask; after a failure, the next in the list. None: the least busy
        """

        def request(server: Transport, left_s: float) -> Awaitable[Answer]:
            return server.infer(model, inputs, outputs, left_s, request_id=request_id)

        return await self._request(model, request, deadline, first)

    async def model_info(
        self, model: str, deadline: Deadline, only: KnownServer | None = None
    ) -> tuple[ModelInfo, KnownServer]:
        """Return a server's description of ``model``, and that server. Raises RewardError.

        only: the server to ask, once and for a short time; None: any
        """
        return await self._request(model, lambda server, left_s: server.model_info(model, left_s), deadline, only=only)

    async def model_infos(self, model: str, deadline: Deadline) -> list[tuple[ModelInfo, KnownServer]]:
        """Return what every reachable server says about ``model``; the first may appear twice.

        Raises RewardError if no server answers.
        """
        infos = [await self.model_info(model, deadline)]  # waits until a server answers
        if len(self._servers) > 1:
            others = [server for server in self._servers if not server.is_left_out]
            left_s = deadline.remaining_s()
            asked = (server.transport.model_info(model, left_s) for server in others)
            for server, outcome in zip(others, await asyncio.gather(*asked, return_exceptions=True), strict=True):
                if isinstance(outcome, ModelInfo):
                    infos.append((outcome, server))
                elif not isinstance(outcome, RewardError):
                    raise outcome
        return infos

    async def is_ready(self, models: Sequence[str], timeout_s: float) -> bool:
        """True as soon as any server has any model in ``models`` ready; False if none has."""
        probes = [
            asyncio.ensure_future(server.transport.is_ready(model, timeout_s))
            for server in self._servers
            for model in models
        ]
        try:
            for answered in asyncio.as_completed(probes):
                if await answered:
                    return True
            return False
        finally:
            for probe in probes:
                probe.cancel()

    def stop_retrying(self) -> None:
        """Let later failures end their calls at once, without a message in the log."""
        self._retry = False

    async def close(self) -> None:
        """Close the connections to all servers. Running requests raise ClientClosedError."""
        self.stop_retrying()
        self._is_closed = True
        await asyncio.gather(*(server.close() for server in self._servers))

    async def _request(
        self,
        model: str,
        request: Request[Answered],
        deadline: Deadline,
        first: int | None = None,
        only: KnownServer | None = None,
    ) -> tuple[Answered, KnownServer]:
        try:
            if self._is_closed:
                raise ClientClosedError("this client is closed")
            if only is not None:
                return await request(only.transport, min(deadline.remaining_s(), PROBE_TIMEOUT_S)), only
            return await self._until_answered(model, request, deadline, first)
        except (asyncio.CancelledError, Exception) as error:
            clear_variables(error)
            if self._is_closed and not _is_task_cancelled():  # closing connections raise errors from many classes
                raise ClientClosedError("this client was closed during the call") from error
            raise

    async def _until_answered(
        self, model: str, request: Request[Answered], deadline: Deadline, first: int | None
    ) -> tuple[Answered, KnownServer]:
        """Run the loop that the module describes."""
        refusals: dict[KnownServer, RewardError] = {}
        failures: dict[KnownServer, ServerUnavailableError] = {}
        has_ended = False  # True: a process or the connection ended during this request
        for attempt in itertools.count():
            server = self._best(refusals, first)
            left_s = deadline.remaining_s()
            asked_at_s = time.monotonic()
            try:
                answer = await self._ask(server, model, request, left_s)
            except DeadlineExceededError as error:  # the server may hang
                self._leave_out(server, model, error)
                failed = failures.get(server)
                if failed is not None and left_s < deadline.timeout_s / 2:
                    raise failed from failed.__cause__  # this failure took most of the time
                raise deadline.exceeded(with_proxy(server.transport.url)) from error
            except (AccessDeniedError, InferenceFailedError, ModelNotFoundError) as error:
                refusals[server] = error
                if not self._retry:
                    self._leave_out(server, model, error)
                    raise
                if refusals.keys() >= set(self._servers):
                    break
            except ServerUnavailableError as error:
                failures[server] = error
                if server.lost_at_s is None and self._retry:
                    server.lost_at_s = time.monotonic()
                    left_s = max(deadline.at_s - server.lost_at_s, 0.0)
                    logger.warning("%s: trying again for up to %.0f s: %s", server.transport.url, left_s, error)
                self._leave_out(server, model, error)
                if error.may_have_ended_server and has_ended:
                    message = f"a process or the connection ended twice during this request: {error.message}"
                    raise ProcessEndedError(f"{server.transport.url}: {message}") from error
                others = set(self._servers) - {server, *refusals}
                has_other = not all(other.is_left_out for other in others)
                wait_s = 0.0 if has_other else pause_s(attempt, LONGEST_PAUSE_S)
                if error.may_have_ended_server:
                    has_ended = True
                    wait_s = random.uniform(0.0, SPREAD_S)
                    if self._retry and not has_other and server.comeback is not None:
                        await asyncio.wait({server.comeback}, timeout=deadline.remaining_s())
                if not self._retry or deadline.ends_within(wait_s):
                    raise
                await asyncio.sleep(wait_s)
                if deadline.ends_within(0):  # the pause took longer than planned
                    raise
            else:
                if server.failures > 0 or asked_at_s - server.answered_at_s > LULL_S:
                    server.described = set()  # a new one: who waits for a description fills the old
                server.failures, server.answered_at_s = 0, time.monotonic()
                if server.lost_at_s is not None:
                    lost_s = time.monotonic() - server.lost_at_s
                    logger.warning("%s: answers again after %.1f s", server.transport.url, lost_s)
                    server.lost_at_s = None
                for other, refusal in refusals.items():  # not before: if all refuse, no server is at fault
                    self._leave_out(other, model, refusal)
                return answer, server
        raise min(refusals.values(), key=lambda error: isinstance(error, ModelNotFoundError))  # which says least

    async def _ask(self, server: KnownServer, model: str, request: Request[Answered], left_s: float) -> Answered:
        """Return the server's answer. A model that answered before and is missing raises ServerUnavailableError."""
        try:
            answer = await server.answer(request, next(self._moments), left_s)
        except ModelNotFoundError as error:
            if model not in self._answered:
                raise
            why = "it answered before: the server restarts, loads another version, or has unloaded it: try again"
            raise ServerUnavailableError(f"{error.fault or error.message}: {why}") from error
        self._answered.add(model)
        return answer

    def _best(self, avoided: Collection[KnownServer], first: int | None) -> KnownServer:
        """Return the server to ask next: ``first`` or the next one that works; without ``first``, the least busy."""

        def rank(number: int) -> tuple[bool, bool, int, int, int]:
            server = self._servers[number]
            behind = 0 if first is None else (number - first) % len(self)
            return server in avoided, server.is_left_out, behind, server.outstanding, server.last_request

        return self._servers[min(range(len(self)), key=rank)]

    def _leave_out(self, server: KnownServer, model: str, error: RewardError) -> None:
        """Leave the server out until it is ready. A single server still gets requests."""
        if server.is_left_out or self._is_closed:
            return  # the same failure, or closing
        server.failures += 1
        if error.may_have_ended_server or len(self._servers) > 1:
            rest_s = 0.0 if error.may_have_ended_server else pause_s(server.failures - 1, LONGEST_REST_S)
            # Triton 2.51 reports a dead model as ready
            restart_s = RESTART_S if isinstance(error, ProcessEndedError) else 0.0
            server.comeback = asyncio.create_task(server.back(model, rest_s, restart_s))


def _is_task_cancelled() -> bool:
    """True if the caller cancelled the running task; known only since Python 3.11."""
    task = asyncio.current_task()
    return bool(task is not None and getattr(task, "cancelling", int)())


def pause_s(attempt: int, longest_s: float) -> float:
    """Return a pause that doubles with each try, up to half of it jitter, so that callers don't retry at once."""
    pause_s = min(longest_s, FIRST_PAUSE_S * 2.0 ** min(attempt, 16))
    return random.uniform(pause_s / 2, pause_s)
