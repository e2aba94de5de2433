# SPDX-License-Identifier: MIT
"""Several servers of one checkpoint as one: the least busy gets the request, one that fails is left out for a while.

A request may end the process that works on it. Sent from server to server it would end one process after the other.
So a request that was with server S when a process of S ended waits for S, since S alone knows which request caused it:
its journal lets the others through and refuses a request that has ended its process twice. Once S is loaded anew, the
request stays with S. If nobody heals S within half of the time that is left, and HEALED_WITHIN_S at most, the request
goes to a server that is not known to be dead. If a process ends there too, the request fails. Either way it ends two
processes at most: two of S, or one of S and one of another. Requests that were with S beside it wait as long, and are
answered if S is healed in that time. No request is sent to a server that is known to be dead, where others are.

A request under which the connection to S ends is treated likewise, for ``rfm serve`` restarts Triton when a process has
died that owed answers. A request that ends Triton itself is in no journal: it ends S again and again, but no other.

A client of one server sends the request to that server again, after pauses, and its journal bounds it. A URL behind
which a load balancer picks the server counts as one server: there the bound holds for each server, not for all
together. Give such servers a URL each, or over gRPC a host name that resolves to all their addresses.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
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
from rfm_client.contract.wire import Tensors
from rfm_client.transport.calls import LATE, Answer, Transport, TritonTransport
from rfm_client.transport.deadline import Deadline
from rfm_client.transport.host_names import REFRESH_S, Name
from rfm_client.transport.ports import OF_A_PORT, wrong_port
from rfm_client.transport.server import HEALED_WITHIN_S, LONGEST_RETRY_PAUSE_S, Server, pause_s

Answered = TypeVar("Answered")
Request = Callable[[Transport, float], Awaitable[Answered]]

logger = logging.getLogger("rfm_client")


class Servers:
    """Sends each request to one of several servers, for one event loop.

    retry: a request that fails because a server is down, restarting or full is sent again until the deadline: at once
        to another server or, when there is none, after pauses that grow. (One under which a server has ended waits for
        that one, see above.) A request that a server denies or fails
        at, or whose model it lacks, is sent once to each other one. A score depends on the request alone, so
        sending it twice is safe.
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
        retry_ended: bool = True,
    ) -> Answer:
        """The named ``outputs`` of ``model`` for ``inputs``. Raises RewardError, which names the request.

        retry_ended: False: it is not sent again when a process ends that has it
        """

        def request(server: Transport, left_s: float) -> Awaitable[Answer]:
            return server.infer(model, inputs, outputs, left_s, request_id=request_id)

        try:
            return await self._request(model, request, deadline, retry_ended=retry_ended)
        except RewardError as error:
            error.request_id = request_id
            await self._look_at_ports(error)
            raise

    async def model_info(self, model: str, deadline: Deadline) -> ModelInfo:
        """What a server says of ``model``. Raises RewardError."""
        self._keep_up()

        def request(server: Transport, left_s: float) -> Awaitable[ModelInfo]:
            return server.model_info(model, left_s)

        try:
            return await self._request_among(None, model, request, deadline)
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

    async def _request(
        self, model: str, request: Request[Answered], deadline: Deadline, *, retry_ended: bool = True
    ) -> Answered:
        """The answer to a request, retried as the module's docstring says."""
        self._keep_up()
        try:
            is_told = not retry_ended or len(self._servers) > 1
            return await self._request_among(None, model, request, deadline, raise_ended=is_told)
        except _EndedAtError as ended:
            first, error = ended.server, ended.error
        if not self._retry or not retry_ended or deadline.ends_within(0):
            raise error
        if await first.is_healed(min(HEALED_WITHIN_S, deadline.remaining_s() / 2)):
            try:
                return await self._request_among(first, model, request, deadline)
            except (AccessDeniedError, InferenceFailedError, ModelNotFoundError):
                pass  # another server may do better
            except ServerUnavailableError:
                if not first.is_gone or deadline.ends_within(0):
                    raise
        try:
            return await self._request_among(None, model, request, deadline, raise_ended=True)
        except _EndedAtError as ended:
            where = f"{first.transport.url} and {ended.server.transport.url}"
            message = f"{where}: each lost its process or the connection under this request, so no other is asked"
            is_process = isinstance(error, ProcessEndedError) or isinstance(ended.error, ProcessEndedError)
            kind = ProcessEndedError if is_process else ServerUnavailableError
            raise kind(f"{message}: {ended.error.message}") from ended.error

    async def _request_among(
        self,
        only: Server | None,
        model: str,
        request: Request[Answered],
        deadline: Deadline,
        *,
        raise_ended: bool = False,
    ) -> Answered:
        """The answer of the server ``only`` or, if that is None, of any.

        raise_ended: raise _EndedAtError where a process of the model, or the connection, has ended; else send the
            request again
        """
        refusals: dict[Server, RewardError] = {}
        failures: dict[Server, ServerUnavailableError] = {}
        for attempt in itertools.count():
            server = only or await self._living(refusals, deadline)
            if server.is_gone:
                raise ServerUnavailableError(f"{server.transport.url}: its name does not stand for it any more")
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
                if only or refusals.keys() >= set(self._servers):
                    break
            except ServerUnavailableError as error:
                self._record_failure(server, model, error)
                failures[server] = error
                if raise_ended and error.may_have_ended_server:
                    raise _EndedAtError(server, error) from error
                has_other = only is None and self._has_other({server, *refusals})
                await self._pause(0.0 if has_other else pause_s(attempt, LONGEST_RETRY_PAUSE_S), deadline, error)
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

    async def _living(self, refusals: Collection[Server], deadline: Deadline) -> Server:
        """The least busy that is not known to be dead, as soon as there is one. Of the only server nothing is known."""
        for attempt in itertools.count():
            server = self._least_busy(refusals)
            if not server.is_dead:
                return server
            error = ProcessEndedError(f"{self}: every process of the model has ended, and none is loaded anew yet")
            await self._pause(pause_s(attempt, LONGEST_RETRY_PAUSE_S), deadline, error)
        raise AssertionError("it counts for ever")

    def _least_busy(self, avoided: Collection[Server]) -> Server:
        def rank(server: Server) -> tuple[bool, bool, bool, int, int]:
            return server in avoided, server.is_dead, server.is_left_out, server.outstanding, server.last_request

        return min(self._servers, key=rank)

    def _record_failure(self, server: Server, model: str, error: ServerUnavailableError) -> None:
        """Records that a server does not answer, and leaves it out."""
        if not server.failures and self._retry:
            logger.warning("%s: trying again: %s", server.transport.url, error)
        self._leave_out(server, model, error)

    def _leave_out(self, server: Server, model: str, error: RewardError) -> None:
        """Leaves a server out until it is ready, or healed. The only server stays in."""
        if not server.is_left_out:  # else it is the same failure
            server.failures += 1
        if len(self._servers) == 1:
            return
        if isinstance(error, ProcessEndedError):
            server.leave_out_dead(model)
        elif isinstance(error, ServerUnavailableError) and error.may_have_ended_server:
            server.leave_out_lost(model)
        else:
            server.leave_out(model)

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


class _EndedAtError(Exception):
    """A process of the model, or the connection, ended at ``server`` when it had the request, or before."""

    def __init__(self, server: Server, error: ServerUnavailableError) -> None:
        super().__init__(server, error)
        self.server = server
        self.error = error
