# SPDX-License-Identifier: MIT
"""Servers of one checkpoint, and the one loop in which a request is asked of them until its deadline.

The least busy server gets a request. One that fails is left out until it says that it is ready; the more often it
failed, the later it is asked. A score depends on the request alone, so that sending it twice is safe:

- a server is down, restarting or full: again, at once to another server or, when there is none, after growing pauses
- a process or the connection ended, perhaps because of this request: once more, when a server can be back; then it
  fails. So one request ends at most two processes
- a server denies it, fails at it, or lacks the model: once to each other server
- the sample is at fault, or the time is up: never again
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import random
import time
from collections.abc import Awaitable, Callable, Collection, Sequence
from typing import TypeVar

from rfm_client.contract.errors import (
    AccessDeniedError,
    DeadlineExceededError,
    InferenceFailedError,
    ModelNotFoundError,
    ProcessEndedError,
    RewardError,
    ServerUnavailableError,
)
from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.triton import LATE
from rfm_client.contract.wire import Tensors
from rfm_client.transport.calls import Answer, Transport, TritonTransport
from rfm_client.transport.deadline import Deadline
from rfm_client.transport.ports import OF_A_PORT, wrong_port

Answered = TypeVar("Answered")
Request = Callable[[Transport, float], Awaitable[Answered]]

FIRST_PAUSE_S = 0.1
LONGEST_PAUSE_S = 2.0
LONGEST_REST_S = 30.0  # of a server that says that it is ready and fails again and again
RESTART_S = 15.0  # longer than `rfm serve` takes to notice that a process has ended, and to start Triton again
SPREAD_S = 1.0  # over which requests come back, so that one that ends its process again takes few others with it
PROBE_TIMEOUT_S = 2.0
_POLL_S = 0.2

logger = logging.getLogger("rfm_client")


class KnownServer:
    """One server of several: its transport, its load and its failures.

    failures: how often it was left out since the last success
    has_answered: it has ever had a success
    comeback: ends when the server says that it is ready again; None: it was never left out
    """

    def __init__(self, transport: Transport) -> None:
        self.transport = transport
        self.outstanding = 0
        self.last_request = 0
        self.failures = 0
        self.has_answered = False
        self.comeback: asyncio.Task[None] | None = None

    @property
    def is_left_out(self) -> bool:
        """Whether the server gets no requests until it says that it is ready."""
        return self.comeback is not None and not self.comeback.done()

    async def answer(self, request: Request[Answered], moment: int, left_s: float) -> Answered:
        """What it answers to the request of this moment."""
        self.outstanding += 1
        self.last_request = moment
        try:
            return await request(self.transport, left_s)
        finally:
            self.outstanding -= 1

    async def rested(self, model: str) -> None:
        """Return when a server that failed says that it is ready, not at once."""
        await asyncio.sleep(pause_s(self.failures - 1, LONGEST_REST_S))
        for attempt in itertools.count():
            if await self.transport.is_ready(model, PROBE_TIMEOUT_S):
                return
            await asyncio.sleep(pause_s(attempt, LONGEST_PAUSE_S))

    async def back(self, model: str, *, was_down: bool) -> None:
        """Return when the server is ready again after a process or the connection ended.

        Triton 2.51 says that a dead model is ready, so it must have said the opposite before, for RESTART_S at most.
        """
        until_s = time.monotonic() + RESTART_S
        while True:
            is_ready = await self.transport.is_ready(model, PROBE_TIMEOUT_S)
            if is_ready and (was_down or time.monotonic() >= until_s):
                return
            was_down = was_down or not is_ready
            await asyncio.sleep(_POLL_S)

    async def close(self) -> None:
        """Close the connection, even if calls still use it."""
        if self.comeback is not None:
            self.comeback.cancel()
        await self.transport.close()


class Servers:
    """Sends each request to one of several servers, for one event loop. retry: whether anything is asked again"""

    def __init__(self, transports: Sequence[Transport], *, retry: bool) -> None:
        if not transports:
            raise ValueError("url: expected at least one, got none")
        self._servers = [KnownServer(transport) for transport in transports]
        self._retry = retry
        self._moments = itertools.count(1)

    def __str__(self) -> str:
        return ", ".join(server.transport.url for server in self._servers)

    async def infer(
        self, model: str, inputs: Tensors, outputs: Collection[str], deadline: Deadline, *, request_id: str
    ) -> Answer:
        """The named ``outputs`` of ``model`` for ``inputs``. Raises RewardError, which names the request."""

        def request(server: Transport, left_s: float) -> Awaitable[Answer]:
            return server.infer(model, inputs, outputs, left_s, request_id=request_id)

        try:
            return await self._request(model, request, deadline)
        except RewardError as error:
            error.request_id = request_id
            raise

    async def model_info(self, model: str, deadline: Deadline) -> ModelInfo:
        """What a server says of ``model``. Raises RewardError."""
        return await self._request(model, lambda server, left_s: server.model_info(model, left_s), deadline)

    async def model_infos(self, model: str, deadline: Deadline) -> list[ModelInfo]:
        """What each server says of ``model``. Left out are those that do not answer, for they score nothing either.

        Raises RewardError if none answers.
        """
        infos = [await self.model_info(model, deadline)]  # as soon as one is there
        if len(self._servers) > 1:
            others = [server.transport for server in self._servers if not server.is_left_out]
            left_s = deadline.remaining_s()
            told = await asyncio.gather(*(each.model_info(model, left_s) for each in others), return_exceptions=True)
            for outcome in told:
                if isinstance(outcome, ModelInfo):
                    infos.append(outcome)
                elif not isinstance(outcome, RewardError):
                    raise outcome
        return infos

    async def is_ready(self, models: Sequence[str], timeout_s: float) -> bool:
        """Whether at least one server has one of the models ready. The first that has is enough."""
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

    async def check_ports(self) -> None:
        """Raises ServerUnavailableError if every URL has a wrong port, which no wait mends."""
        named = await self._wrong_ports()
        if named and named[0] is not None and all(named):
            raise ServerUnavailableError(named[0])

    def stop_retrying(self) -> None:
        """Has calls that fail from now on fail at once, and without a word in the log."""
        self._retry = False

    async def close(self) -> None:
        """Closes the connections to all servers."""
        self.stop_retrying()
        await asyncio.gather(*(server.close() for server in self._servers))

    async def _request(self, model: str, request: Request[Answered], deadline: Deadline) -> Answered:
        try:
            return await self._until_answered(model, request, deadline)
        except OF_A_PORT as error:
            if not any(server.has_answered for server in self._servers):
                for named in filter(None, await self._wrong_ports()):
                    raise ServerUnavailableError(named) from error
            raise

    async def _until_answered(self, model: str, request: Request[Answered], deadline: Deadline) -> Answered:
        """The loop that the module describes."""
        refusals: dict[KnownServer, RewardError] = {}
        failures: dict[KnownServer, ServerUnavailableError] = {}
        has_ended = False  # a process, or the connection, under this request
        for attempt in itertools.count():
            server = self._least_busy(refusals)
            left_s = deadline.remaining_s()
            try:
                answer = await server.answer(request, next(self._moments), left_s)
            except DeadlineExceededError as error:  # perhaps it hangs
                self._leave_out(server, model, error)
                failed = failures.get(server)
                if failed is not None and left_s < deadline.timeout_s / 2:
                    raise failed from failed.__cause__  # the reason for most of the time
                where = error.message.rpartition(f": {LATE}")[0] or server.transport.url
                raise deadline.exceeded(where) from error
            except (AccessDeniedError, InferenceFailedError, ModelNotFoundError) as error:
                refusals[server] = error
                if not self._retry:
                    self._leave_out(server, model, error)
                    raise
                if refusals.keys() >= set(self._servers):
                    break
            except ServerUnavailableError as error:
                failures[server] = error
                if not server.failures and self._retry:
                    logger.warning("%s: trying again: %s", server.transport.url, error)
                self._leave_out(server, model, error)
                if error.may_have_ended_server and has_ended:
                    message = f"a process or the connection ended under this request twice: {error.message}"
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
                if deadline.ends_within(0):  # the pause took longer than it should have
                    raise
            else:
                server.failures, server.has_answered = 0, True
                for other, refusal in refusals.items():  # not before: what all refuse is not one server's fault
                    self._leave_out(other, model, refusal)
                return answer
        raise min(refusals.values(), key=lambda error: isinstance(error, ModelNotFoundError))  # which says the least

    def _least_busy(self, avoided: Collection[KnownServer]) -> KnownServer:
        def rank(server: KnownServer) -> tuple[bool, bool, int, int]:
            return server in avoided, server.is_left_out, server.outstanding, server.last_request

        return min(self._servers, key=rank)

    def _leave_out(self, server: KnownServer, model: str, error: RewardError) -> None:
        """Leave a server out until it is ready. To the only one requests are sent all the same."""
        if server.is_left_out:
            return  # it is the same failure
        server.failures += 1
        if error.may_have_ended_server:
            was_down = not isinstance(error, ProcessEndedError)
            server.comeback = asyncio.create_task(server.back(model, was_down=was_down))
        elif len(self._servers) > 1:
            server.comeback = asyncio.create_task(server.rested(model))

    async def _wrong_ports(self) -> list[str | None]:
        """What is wrong with the port of each server."""
        ours = [server.transport.url for server in self._servers if isinstance(server.transport, TritonTransport)]
        return [await asyncio.to_thread(wrong_port, url) for url in ours]


def pause_s(attempt: int, longest_s: float) -> float:
    """Doubles from try to try; half of it is chance, so that callers do not come back all at once."""
    pause_s = min(longest_s, FIRST_PAUSE_S * 2.0 ** min(attempt, 16))
    return random.uniform(pause_s / 2, pause_s)
