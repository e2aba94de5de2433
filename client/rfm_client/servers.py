# SPDX-License-Identifier: MIT
"""Several servers of one checkpoint as one: the least busy is asked, and one that fails is left out for a while."""

from __future__ import annotations

import asyncio
import itertools
import logging
import random
from collections.abc import Awaitable, Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from rfm_client.deadline import Deadline
from rfm_client.errors import (
    AccessDeniedError,
    DeadlineExceededError,
    InferenceFailedError,
    ModelNotFoundError,
    RewardError,
    ServerUnavailableError,
)
from rfm_client.model_info import ModelInfo
from rfm_client.transport import Answer, Transport
from rfm_client.wire import Tensors

Answered = TypeVar("Answered")

FIRST_PAUSE_S = 0.1
LONGEST_RETRY_PAUSE_S = 2.0
LONGEST_REST_S = 30.0  # of a server that says that it is ready and fails again and again
PROBE_TIMEOUT_S = 2.0

logger = logging.getLogger("rfm_client")


class Servers:
    """Asks one of several servers, for one event loop.

    retry: what fails because a server is down, restarting or full is asked again, elsewhere at once or, when there is
        no other, after pauses that grow, until the deadline; what a server lacks, denies or fails at is asked once of
        each other one. A score depends on the request alone, so asking twice is safe.
    """

    def __init__(self, transports: Sequence[Transport], *, retry: bool) -> None:
        if not transports:
            raise ValueError("url: expected at least one, got none")
        self._servers = [_Server(transport) for transport in transports]
        self._retry = retry

    def __str__(self) -> str:
        return ", ".join(server.transport.url for server in self._servers)

    async def infer(
        self, model: str, inputs: Tensors, outputs: Collection[str], deadline: Deadline, *, request_id: str
    ) -> Answer:
        """The named ``outputs`` of ``model`` for ``inputs``. Raises RewardError, which names the request."""

        def ask(server: Transport, left_s: float) -> Awaitable[Answer]:
            return server.infer(model, inputs, outputs, left_s, request_id=request_id)

        try:
            return await self._ask(model, ask, deadline)
        except RewardError as error:
            error.request_id = request_id
            raise

    async def model_info(self, model: str, deadline: Deadline) -> ModelInfo:
        """What a server tells of ``model``. Raises RewardError."""
        return await self._ask(model, lambda server, left_s: server.model_info(model, left_s), deadline)

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

    async def close(self) -> None:
        """Closes all connections."""
        self._retry = False
        for server in self._servers:
            if server.comeback is not None:
                server.comeback.cancel()
        await asyncio.gather(*(server.transport.close() for server in self._servers))

    async def _ask(
        self, model: str, ask: Callable[[Transport, float], Awaitable[Answered]], deadline: Deadline
    ) -> Answered:
        refusals: dict[_Server, RewardError] = {}
        for attempt in itertools.count():
            server = self._least_busy(refusals)
            left_s = deadline.remaining_s()
            try:
                with server.asked():
                    answer = await ask(server.transport, left_s)
                server.failures = 0
                for other in refusals:  # not before: what all refuse is no fault of one
                    self._leave_out(other, model)
                return answer
            except DeadlineExceededError as error:  # perhaps it hangs
                self._leave_out(server, model)
                raise deadline.exceeded(server.transport.url) from error
            except (AccessDeniedError, InferenceFailedError, ModelNotFoundError) as error:
                refusals[server] = error
                if not self._retry:
                    self._leave_out(server, model)
                    raise
                if len(refusals) == len(self._servers):
                    break
            except ServerUnavailableError as error:
                if not server.failures and self._retry:
                    logger.warning("%s: trying again: %s", server.transport.url, error)
                self._leave_out(server, model)
                has_other = any(not other.is_left_out for other in self._servers if other not in {server, *refusals})
                pause_s = 0.0 if has_other else _pause_s(attempt, LONGEST_RETRY_PAUSE_S)
                if not self._retry or deadline.ends_within(pause_s):
                    raise
                await asyncio.sleep(pause_s)
                if deadline.ends_within(0):  # the pause took longer than it should have
                    raise
        others = [error for error in refusals.values() if not isinstance(error, ModelNotFoundError)]
        raise (others or list(refusals.values()))[0]

    def _least_busy(self, avoided: Collection[_Server]) -> _Server:
        def rank(server: _Server) -> tuple[bool, bool, int, int]:
            return server in avoided, server.is_left_out, server.outstanding, server.last_asked

        return min(self._servers, key=rank)

    def _leave_out(self, server: _Server, model: str) -> None:
        """Until it says that it is ready. The only server there is stays in."""
        server.failures += 1
        if len(self._servers) > 1 and not server.is_left_out:
            server.comeback = asyncio.create_task(server.rest(model))


class _Server:
    """What is known of one server. failures: one after the other, up to now."""

    _moments = itertools.count(1)

    def __init__(self, transport: Transport) -> None:
        self.transport = transport
        self.outstanding = 0
        self.last_asked = 0
        self.failures = 0
        self.comeback: asyncio.Task[None] | None = None

    @property
    def is_left_out(self) -> bool:
        return self.comeback is not None and not self.comeback.done()

    @contextmanager
    def asked(self) -> Iterator[None]:
        self.outstanding += 1
        self.last_asked = next(self._moments)
        try:
            yield
        finally:
            self.outstanding -= 1

    async def rest(self, model: str) -> None:
        """Ends when it says that it is ready; the more often it has failed, the later it is asked."""
        await asyncio.sleep(_pause_s(self.failures - 1, LONGEST_REST_S))
        for attempt in itertools.count():
            if await self.transport.is_ready(model, PROBE_TIMEOUT_S):
                return
            await asyncio.sleep(_pause_s(attempt, LONGEST_RETRY_PAUSE_S))


def _pause_s(attempt: int, longest_s: float) -> float:
    """Doubles from try to try; half of it is chance, so that callers do not come back all at once."""
    pause_s = min(longest_s, FIRST_PAUSE_S * 2.0 ** min(attempt, 16))
    return random.uniform(pause_s / 2, pause_s)
