# SPDX-License-Identifier: MIT
"""Several servers of one checkpoint as one: the least busy gets the request, one that fails is left out for a while.

A request may end the process that works on it. So a request under which a process, or the connection, ended is sent
once more, when a server can be back; then it fails. One request ends at most two processes.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import random
import time
from collections.abc import Awaitable, Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
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
from rfm_client.contract.wire import Tensors
from rfm_client.transport.calls import LATE, Answer, Transport, TritonTransport
from rfm_client.transport.deadline import Deadline
from rfm_client.transport.host_names import REFRESH_S, Name
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


class Server:
    """One server of several: its transport, its load and its failures.

    failures: how often it was left out since the last success
    has_answered: it has ever had a success
    comeback: ends when the server says that it is ready again; None: it was never left out
    is_gone: it gets no more requests, and is closed as soon as nothing uses it
    """

    _moments = itertools.count(1)

    def __init__(self, transport: Transport) -> None:
        self.transport = transport
        self.outstanding = 0
        self.last_request = 0
        self.failures = 0
        self.has_answered = False
        self.comeback: asyncio.Task[None] | None = None
        self.is_gone = False
        self._closing: asyncio.Task[None] | None = None

    @property
    def is_left_out(self) -> bool:
        """Whether the server gets no requests until it says that it is ready."""
        return self.comeback is not None and not self.comeback.done()

    @contextmanager
    def request_under_way(self) -> Iterator[None]:
        """A context in which a request to this server is under way."""
        self.outstanding += 1
        self.last_request = next(self._moments)
        try:
            yield
        finally:
            self.outstanding -= 1
            self._close_if_unused()

    def leave_out(self, model: str, error: RewardError) -> None:
        """Leave the server out until it says that it is ready. The more often it failed, the later it is asked."""
        if self.is_left_out or self.is_gone:
            return
        if error.may_have_ended_server:
            comeback = self._back(model, was_down=not isinstance(error, ProcessEndedError))
        else:
            comeback = self._rest(model)
        self.comeback = asyncio.create_task(comeback)

    def remove(self) -> None:
        """Send it no more requests."""
        self.is_gone = True
        if self.comeback is not None:
            self.comeback.cancel()
        self._close_if_unused()

    @property
    def is_closed(self) -> bool:
        """Whether nothing of it is left."""
        return self._closing is not None and self._closing.done()

    async def close(self) -> None:
        """Close the connection, even if calls still use it."""
        self.is_gone = True
        if self.comeback is not None:
            self.comeback.cancel()
        if self._closing is None:
            self._closing = asyncio.create_task(self.transport.close())
        await self._closing

    def _close_if_unused(self) -> None:
        if self.is_gone and not self.outstanding and self._closing is None:
            self._closing = asyncio.create_task(self.transport.close())

    async def _rest(self, model: str) -> None:
        await asyncio.sleep(pause_s(self.failures - 1, LONGEST_REST_S))
        for attempt in itertools.count():
            if await self.transport.is_ready(model, PROBE_TIMEOUT_S):
                return
            await asyncio.sleep(pause_s(attempt, LONGEST_PAUSE_S))

    async def _back(self, model: str, *, was_down: bool) -> None:
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


class Servers:
    """Sends each request to one of several servers, for one event loop.

    retry: a request that fails because a server is down, restarting or full is sent again until the deadline: at once
        to another server or, when there is none, after pauses that grow. A request that a server denies or fails at, or
        whose model it lacks, is sent once to each other one. A score depends on the request alone, so sending it twice
        is safe
    names: whose addresses are servers, too
    """

    def __init__(self, transports: Sequence[Transport], *, retry: bool, names: Sequence[Name] = ()) -> None:
        if not transports and not names:
            raise ValueError("url: expected at least one, got none")
        self._transports = transports
        self._names = names
        self._servers = [Server(transport) for transport in self._wanted]
        self._gone: list[Server] = []  # and perhaps not closed yet
        self._retry = retry
        self._looking_up: asyncio.Task[None] | None = None
        self._looked_up_s = float("-inf")

    def __str__(self) -> str:
        return ", ".join(server.transport.url for server in self._servers)

    def __len__(self) -> int:
        return len(self._servers)

    async def infer(
        self,
        model: str,
        inputs: Tensors,
        outputs: Collection[str],
        deadline: Deadline,
        *,
        request_id: str,
    ) -> Answer:
        """The named ``outputs`` of ``model`` for ``inputs``. Raises RewardError, which names the request."""

        def request(server: Transport, left_s: float) -> Awaitable[Answer]:
            return server.infer(model, inputs, outputs, left_s, request_id=request_id)

        try:
            return await self._request(model, request, deadline)
        except RewardError as error:
            error.request_id = request_id
            await self._look_at_ports(error)
            raise

    async def model_info(self, model: str, deadline: Deadline) -> ModelInfo:
        """What a server says of ``model``. Raises RewardError."""

        def request(server: Transport, left_s: float) -> Awaitable[ModelInfo]:
            return server.model_info(model, left_s)

        try:
            return await self._request(model, request, deadline)
        except RewardError as error:
            await self._look_at_ports(error)
            raise

    async def check_ports(self) -> None:
        """Raises ServerUnavailableError if every URL has a wrong port, which no wait mends."""
        named = await self._wrong_ports()
        if named and named[0] is not None and all(named):
            raise ServerUnavailableError(named[0])

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
        self._keep_up()
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
        """Has calls that fail from now on fail at once, and without a word in the log."""
        self._retry = False

    async def close(self) -> None:
        """Closes the connections to all servers."""
        self.stop_retrying()
        if self._looking_up is not None:
            self._looking_up.cancel()
        await asyncio.gather(*(server.close() for server in (*self._servers, *self._gone)))

    async def _request(self, model: str, request: Request[Answered], deadline: Deadline) -> Answered:
        """The answer to a request, sent again as the class's docstring says."""
        self._keep_up()
        refusals: dict[Server, RewardError] = {}
        failures: dict[Server, ServerUnavailableError] = {}
        has_ended = False  # a process, or the connection, under this request
        for attempt in itertools.count():
            server = self._least_busy(refusals)
            left_s = deadline.remaining_s()
            try:
                with server.request_under_way():
                    answer = await request(server.transport, left_s)
                server.failures, server.has_answered = 0, True
                for other, refusal in refusals.items():  # not before: what all refuse is not one server's fault
                    self._leave_out(other, model, refusal)
                return answer
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
                self._record_failure(server, model, error)
                failures[server] = error
                if error.may_have_ended_server and has_ended:
                    message = f"a process or the connection ended under this request twice: {error.message}"
                    raise ProcessEndedError(f"{server.transport.url}: {message}") from error
                has_other = self._has_other({server, *refusals})
                if error.may_have_ended_server:
                    has_ended = True
                    await self._wait_for_comeback(server, deadline, error, has_other=has_other)
                else:
                    await self._pause(0.0 if has_other else pause_s(attempt, LONGEST_PAUSE_S), deadline, error)
        raise min(refusals.values(), key=lambda error: isinstance(error, ModelNotFoundError))  # which says the least

    async def _look_at_ports(self, error: RewardError) -> None:
        """Raises a better error than that with which a call fails for good, if the port of a URL is to blame."""
        if isinstance(error, OF_A_PORT) and not any(server.has_answered for server in self._servers):
            for named in filter(None, await self._wrong_ports()):
                told = ServerUnavailableError(named)
                told.request_id = error.request_id
                raise told from error

    async def _wrong_ports(self) -> list[str | None]:
        """What is wrong with the port of each server."""
        ours = [server.transport.url for server in self._servers if isinstance(server.transport, TritonTransport)]
        return [await asyncio.to_thread(wrong_port, url) for url in ours]

    def _has_other(self, busy: Collection[Server]) -> bool:
        """Whether a server that is neither busy nor left out can take the request at once."""
        return any(not server.is_left_out for server in self._servers if server not in busy)

    async def _pause(self, duration_s: float, deadline: Deadline, error: ServerUnavailableError) -> None:
        """Raises the error if it is not worth while."""
        if not self._retry or deadline.ends_within(duration_s):
            raise error
        await asyncio.sleep(duration_s)
        if deadline.ends_within(0):  # the pause took longer than it should have
            raise error

    async def _wait_for_comeback(
        self, server: Server, deadline: Deadline, error: ServerUnavailableError, *, has_other: bool
    ) -> None:
        """Returns when a request under which ``server`` has ended can be sent once more. Raises ``error`` if it cannot.

        has_other: another server can take it
        """
        if self._retry and not has_other and server.comeback is not None:
            await asyncio.wait({server.comeback}, timeout=deadline.remaining_s())
        await self._pause(random.uniform(0.0, SPREAD_S), deadline, error)

    def _least_busy(self, avoided: Collection[Server]) -> Server:
        def rank(server: Server) -> tuple[bool, bool, int, int]:
            return server in avoided, server.is_left_out, server.outstanding, server.last_request

        return min(self._servers, key=rank)

    def _record_failure(self, server: Server, model: str, error: ServerUnavailableError) -> None:
        """Records that a server does not answer, and leaves it out."""
        if not server.failures and self._retry:
            logger.warning("%s: trying again: %s", server.transport.url, error)
        self._leave_out(server, model, error)

    def _leave_out(self, server: Server, model: str, error: RewardError) -> None:
        """Leaves a server out until it is ready. To the only one requests are sent all the same."""
        server.failures += not server.is_left_out  # else it is the same failure
        if len(self._servers) > 1 or error.may_have_ended_server:
            server.leave_out(model, error)

    # Names

    @property
    def _wanted(self) -> list[Transport]:
        return [*self._transports, *(found for name in self._names for found in name.transports.values())]

    def _keep_up(self) -> None:
        """Has the names looked up when that is due. Nobody waits for it."""
        is_due = time.monotonic() - self._looked_up_s >= REFRESH_S
        if self._names and is_due and (self._looking_up is None or self._looking_up.done()):
            self._looking_up = asyncio.create_task(self._look_up())

    async def _look_up(self) -> None:
        for name in self._names:
            try:
                await name.look_up()
            except (OSError, UnicodeError) as error:
                logger.info("%s: the name cannot be looked up: %s", name.url, error)
        self._looked_up_s = time.monotonic()
        known = {id(server.transport): server for server in self._servers}
        self._servers = [known.get(id(transport)) or Server(transport) for transport in self._wanted]
        removed = [server for server in known.values() if server not in self._servers]
        for server in removed:
            server.remove()
        self._gone = [*(server for server in self._gone if not server.is_closed), *removed]


def pause_s(attempt: int, longest_s: float) -> float:
    """Doubles from try to try; half of it is chance, so that callers do not come back all at once."""
    pause_s = min(longest_s, FIRST_PAUSE_S * 2.0 ** min(attempt, 16))
    return random.uniform(pause_s / 2, pause_s)
