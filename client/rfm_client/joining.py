# SPDX-License-Identifier: MIT
"""Concurrent calls about one sample each share requests.

Eight samples in one request cost client and server little more than one. So while as many requests are under way as
keep all instances of the model busy, samples that come meanwhile wait a little and go together. Nothing waits while
fewer requests are under way: a call is then sent at once, by itself.

Calls of one kind share requests: the same model, widths and outputs, and time limits within a factor of two, so that
a server that hangs is noticed nearly as soon. Each call keeps its own deadline, cancellation and error.

Where a process of the model, or the connection, ends under a joint request, nothing is joined for APART_S. Asked about
alone, the sample that did it is known to the server by itself, and refused; no other is blamed.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import deque
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

from rfm_client.batching import array_bytes, num_together
from rfm_client.call import Call, new_request_ids
from rfm_client.contract.errors import RewardError
from rfm_client.contract.results import Result
from rfm_client.contract.samples import Sample
from rfm_client.model_infos import ModelInfos
from rfm_client.transport.deadline import Deadline, latest
from rfm_client.transport.servers import Servers

Outcome: TypeAlias = Result | RewardError
Ask: TypeAlias = Callable[[str, Sequence[Sample], Call], Coroutine[Any, Any, Sequence[Outcome]]]

REQUESTS_AN_INSTANCE = 2  # one that it works on, and one that lies ready
LONGEST_WAIT_S = 0.002  # a server far away needs more requests under way: by this it answers nearly as many as apart
APART_S = 600.0  # as long as a server refuses what has ended its process
_ENDS_SOON_S = 1.0

logger = logging.getLogger("rfm_client")


class Joining:
    """Gives samples of concurrent calls to ``ask`` together, for one event loop."""

    def __init__(self, ask: Ask, infos: ModelInfos, servers: Servers) -> None:
        self._ask = ask
        self._infos = infos
        self._servers = servers
        self._lanes: dict[_Kind, _Lane] = {}
        self._apart_until_s = float("-inf")

    async def outcome(self, model: str, sample: Sample, call: Call) -> Outcome:
        """The outcome of a sample with embeddings, from a request of its own or one that it shares."""
        kind = _Kind.of(model, sample, call)
        lane = self._lanes.get(kind)
        if lane is None:
            lane = self._lanes[kind] = _Lane(kind)
        elif lane.num_requests >= self._limit(model):
            return await self._wait(lane, sample, call.deadline)
        lane.begin(1)
        try:
            (outcome,) = await self._ask(model, [sample], call)
            return outcome
        finally:
            lane.end(1)
            self._proceed(lane)

    def stay_apart(self) -> None:
        """Joins nothing for APART_S."""
        logger.warning("a process or the connection ended under samples of several calls: none are joined for a while")
        self._apart_until_s = time.monotonic() + APART_S

    def _limit(self, model: str) -> float:
        """How many requests under way keep the instances busy. Infinite: nothing is joined."""
        info = self._infos.known(model)
        if info is None:
            self._infos.request(model)
            return math.inf
        if time.monotonic() < self._apart_until_s:
            return math.inf
        return REQUESTS_AN_INSTANCE * max(info.instances * len(self._servers), 1)

    async def _wait(self, lane: _Lane, sample: Sample, deadline: Deadline) -> Outcome:
        """The outcome of a sample that goes with the next request."""
        loop = asyncio.get_running_loop()
        waiter = _Waiter(sample, sum(array_bytes(sample)), deadline, loop.create_future())
        late = loop.call_later(deadline.remaining_s(), self._expire, lane, waiter)
        lane.waiting.append(waiter)
        if lane.overdue is None:
            lane.overdue = loop.call_later(LONGEST_WAIT_S, self._send_overdue, lane)
        try:
            return await waiter.outcome
        except asyncio.CancelledError:
            lane.give_up(waiter)
            raise
        finally:
            late.cancel()

    def _expire(self, lane: _Lane, waiter: _Waiter) -> None:
        if not waiter.outcome.done():
            waiter.outcome.set_result(waiter.deadline.exceeded(str(self._servers)))
            lane.give_up(waiter)

    def _proceed(self, lane: _Lane) -> None:
        """Sends what waits, as far as the limit allows."""
        limit = self._limit(lane.kind.model) if lane.waiting else 0
        while lane.waiting and lane.num_requests < limit:
            self._send(lane, limit)
        if not lane.waiting:
            lane.rest()
            if not lane.num_requests:
                self._lanes.pop(lane.kind, None)

    def _send_overdue(self, lane: _Lane) -> None:
        lane.overdue = None
        limit = self._limit(lane.kind.model)
        while lane.waiting:
            self._send(lane, limit)

    def _send(self, lane: _Lane, limit: float) -> None:
        """Sends a fair share of all samples, so that each instance has its part."""
        info = self._infos.known(lane.kind.model)
        share = math.ceil((len(lane.waiting) + lane.num_samples) / limit)
        waiters = lane.take(max(1, min(share, info.max_batch_size if info else 1)))
        request = _Request(waiters, latest(waiter.deadline for waiter in waiters))
        call = Call(request.deadline, lane.kind.outputs, new_request_ids(None), is_joint=len(waiters) > 1)
        lane.begin(len(waiters))
        request.task = asyncio.create_task(self._ask(lane.kind.model, [waiter.sample for waiter in waiters], call))
        request.task.add_done_callback(partial(self._finish, lane, request))
        for waiter in waiters:
            waiter.request = request

    def _finish(self, lane: _Lane, request: _Request, task: asyncio.Task[Sequence[Outcome]]) -> None:
        lane.end(len(request.waiters))
        error = None if task.cancelled() else task.exception()
        outcomes = [None] * len(request.waiters) if task.cancelled() or error else task.result()
        for waiter, outcome in zip(request.waiters, outcomes, strict=True):
            if waiter.outcome.done():  # it is late, or cancelled
                continue
            if outcome is not None:
                waiter.outcome.set_result(outcome)
            elif error is not None:
                waiter.outcome.set_exception(error)
            else:  # the client is being closed
                waiter.outcome.cancel()
        self._proceed(lane)


class _Kind(NamedTuple):
    """What samples have in common that may share a request. time_power: which power of two its time limit is below"""

    model: str
    video_shape: tuple[int, ...]
    text_shape: tuple[int, ...]
    outputs: tuple[str, ...]
    time_power: int

    @classmethod
    def of(cls, model: str, sample: Sample, call: Call) -> _Kind:
        """The kind of a sample with embeddings."""
        first = sample.trajectories[0]
        text_shape = () if first.text_embedding is None else first.text_embedding.shape
        power = math.frexp(call.deadline.timeout_s)[1]
        return cls(model, first.positions.shape[1:], text_shape, call.outputs, power)


@dataclass(eq=False)
class _Waiter:
    """A call that does not send its sample itself. request: with which it went"""

    sample: Sample
    num_bytes: int
    deadline: Deadline
    outcome: asyncio.Future[Outcome]
    request: _Request | None = None


@dataclass(eq=False)
class _Request:
    """A joint request under way. deadline: the last of its callers'"""

    waiters: Sequence[_Waiter]
    deadline: Deadline
    task: asyncio.Task[Sequence[Outcome]] | None = None

    def cancel_if_deserted(self) -> None:
        """Cancels it if nobody waits any more. At its deadline it ends itself, and so tells that the server hangs."""
        is_deserted = all(waiter.outcome.done() for waiter in self.waiters)
        if is_deserted and self.task is not None and not self.deadline.ends_within(_ENDS_SOON_S):
            self.task.cancel()


class _Lane:
    """The calls of one kind: those that wait, and how many requests and samples are under way."""

    def __init__(self, kind: _Kind) -> None:
        self.kind = kind
        self.num_requests = 0
        self.num_samples = 0
        self.waiting: deque[_Waiter] = deque()
        self.overdue: asyncio.TimerHandle | None = None  # when the first that waits has waited for long enough

    def begin(self, num_samples: int) -> None:
        """Counts a request of so many samples."""
        self.num_requests += 1
        self.num_samples += num_samples

    def end(self, num_samples: int) -> None:
        """Counts it no more."""
        self.num_requests -= 1
        self.num_samples -= num_samples

    def take(self, most: int) -> list[_Waiter]:
        """The first that wait, as many as fit into one request, and ``most`` at most."""
        count = num_together((waiter.num_bytes for waiter in self.waiting), most)
        return [self.waiting.popleft() for _ in range(count)]

    def give_up(self, waiter: _Waiter) -> None:
        """Forgets a call that waits no more."""
        if waiter.request is not None:
            waiter.request.cancel_if_deserted()
        elif waiter in self.waiting:
            self.waiting.remove(waiter)

    def rest(self) -> None:
        """Forgets when the first one has waited for long enough, since nobody waits any more."""
        if self.overdue is not None:
            self.overdue.cancel()
            self.overdue = None
