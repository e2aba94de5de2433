# SPDX-License-Identifier: MIT
"""Concurrent calls that share requests. Most ask a stand-in that answers when it is told to; the last ones a Triton."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Collection, Coroutine, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from mixtures import MODEL, assert_same, counts, mixed_samples
from reference_server import Served
from rfm_client import (
    AsyncRewardClient,
    DeadlineExceededError,
    InferenceFailedError,
    InvalidSampleError,
    ModelNotFoundError,
    PreferenceSample,
    ProcessEndedError,
    ProgressResult,
    ProgressSample,
    Result,
    RewardClient,
    RewardError,
    Sample,
    ServerUnavailableError,
    SimilaritySample,
    Trajectory,
)
from rfm_client.batching import MAX_REQUEST_BYTES, num_together
from rfm_client.contract import wire
from rfm_client.contract.model_info import ModelInfo
from rfm_client.transport.calls import Answer
from rfm_client.transport.deadline import Deadline, timeout
from rfm_client.transport.in_flight import InFlight
from trajectories import random_trajectory

WITHIN_S = 10.0
LIMIT = 2  # of one server of one instance
BAD = -1.0  # in the embeddings of a sample that a stand-in refuses


def sample_of(value: float, num_frames: int = 3) -> ProgressSample:
    """One that a stand-in answers with this value."""
    embeddings = np.full((num_frames, 4), value, np.float32)
    return ProgressSample(Trajectory(video_embeddings=embeddings, text_embedding=np.ones(2, np.float32)))


@dataclass
class Asked:
    """A request that has come, and when it is answered."""

    inputs: wire.Tensors
    outputs: Collection[str]
    timeout_s: float
    request_id: str
    gate: asyncio.Future[None]
    is_cancelled: bool = False

    @property
    def values(self) -> list[float]:
        return [float(value) for value in self.inputs[wire.VIDEO_EMBEDDINGS][:, 0, 0]]

    def answer(self) -> None:
        self.gate.set_result(None)

    def fail(self, error: Exception) -> None:
        self.gate.set_exception(error)


@dataclass
class Stand:
    """A server that answers each frame with its first number, when a request is answered. is_open: at once"""

    url: str = "grpc://stand:1"
    instances: int = 1
    max_batch_size: int = 64
    is_open: bool = False
    info_error: RewardError | None = None
    asked: list[Asked] = field(default_factory=list)
    num_infos: int = 0

    @property
    def waiting(self) -> list[Asked]:
        return [asked for asked in self.asked if not asked.gate.done()]

    async def infer(
        self, model: str, inputs: wire.Tensors, outputs: Collection[str], timeout_s: float, *, request_id: str = ""
    ) -> Answer:
        asked = Asked(inputs, outputs, timeout_s, request_id, asyncio.get_running_loop().create_future())
        self.asked.append(asked)
        if self.is_open:
            asked.answer()
        try:
            async with timeout(timeout_s):
                await asked.gate
        except (asyncio.TimeoutError, TimeoutError):  # in Python 3.10 two
            raise DeadlineExceededError("no answer in time") from None
        except asyncio.CancelledError:
            asked.is_cancelled = True
            raise
        if BAD in asked.values:
            raise InvalidSampleError("video_embeddings: expected good ones, got bad ones")
        scores = inputs[wire.VIDEO_EMBEDDINGS][:, :, 0]
        per_sample = {wire.PREFERENCE, wire.SIMILARITY}
        return Answer({name: scores[:, :1] if name in per_sample else scores for name in outputs}, "1")

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        self.num_infos += 1
        if self.info_error is not None:
            raise self.info_error
        none = dict.fromkeys(("max_frames", "frame_size", "video_dim", "text_dim", "progress_bins"))
        return ModelInfo(model, ("1",), self.max_batch_size, **none, instances=self.instances)  # type: ignore[arg-type]

    async def is_ready(self, model: str, timeout_s: float) -> bool:
        return True

    async def close(self) -> None:
        pass


async def until(is_so: Callable[[], object]) -> None:
    async def poll() -> None:
        while not is_so():
            await asyncio.sleep(0)

    await asyncio.wait_for(poll(), WITHIN_S)


class Calls:
    """A client of stand-ins that knows their limits, and calls that are under way."""

    def __init__(self, *stands: Stand, **options: Any) -> None:
        self.stands = stands or (Stand(),)
        self.client = AsyncRewardClient("", transports=self.stands, **{"join": True, **options})
        self.tasks: list[asyncio.Task[Result]] = []

    @property
    def stand(self) -> Stand:
        return self.stands[0]

    @property
    def asked(self) -> list[Asked]:
        return [asked for stand in self.stands for asked in stand.asked]

    async def begin(self, *samples: Sample, **options: Any) -> list[asyncio.Task[Result]]:
        """Calls about these samples, which have come as far as they come by themselves."""
        tasks = [asyncio.create_task(self.client.score(sample, **options)) for sample in samples]
        self.tasks += tasks
        for _ in range(20):
            await asyncio.sleep(0)
        return tasks

    async def fill(self, limit: int = LIMIT) -> None:
        """As many calls as go at once, so that the next ones wait."""
        await self.begin(*(sample_of(100 + number) for number in range(limit)))
        assert [asked.values for asked in self.asked] == [[100.0 + number] for number in range(limit)]

    async def answer_all(self) -> list[Result | BaseException]:
        """The outcomes of all calls; requests are answered as they come."""

        async def answering() -> None:
            while True:
                for stand in self.stands:
                    for asked in stand.waiting:
                        asked.answer()
                await asyncio.sleep(0)

        answers = asyncio.create_task(answering())
        try:
            return await asyncio.wait_for(asyncio.gather(*self.tasks, return_exceptions=True), WITHIN_S)
        finally:
            answers.cancel()

    async def __aenter__(self) -> Calls:
        with suppress(RewardError):
            await self.client.model_info()
        return self

    async def __aexit__(self, *_: object) -> None:
        for task in self.tasks:
            task.cancel()
        await asyncio.gather(*self.tasks, return_exceptions=True)
        await self.client.close()


def run(test: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(asyncio.wait_for(test(), 3 * WITHIN_S))


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples wait until a request has ended, however long that takes."""
    monkeypatch.setattr("rfm_client.joining.LONGEST_WAIT_S", 1e3)


class Clock:
    """Time that may leap."""

    def __init__(self) -> None:
        self.ahead_s = 0.0
        self._real = time.monotonic

    def monotonic(self) -> float:
        return self._real() + self.ahead_s

    def advance(self, seconds: float) -> None:
        self.ahead_s += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """That of event loops and deadlines."""
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock.monotonic)
    return clock


def values_of(outcomes: Sequence[object]) -> list[float | None]:
    return [float(o.progress[0]) if isinstance(o, ProgressResult) else None for o in outcomes]


@pytest.mark.usefixtures("patient")
def test_what_comes_while_the_servers_are_busy_shares_the_next_request() -> None:
    async def ask() -> None:
        async with Calls() as calls:
            await calls.fill()
            waiting = await calls.begin(*map(sample_of, range(6)))
            assert len(calls.asked) == LIMIT
            calls.asked[0].answer()
            await until(lambda: len(calls.asked) == LIMIT + 1)
            assert calls.asked[-1].values == [0, 1, 2, 3]  # half of the eight that are there
            calls.asked[1].answer()
            await until(lambda: len(calls.asked) == LIMIT + 2)
            assert calls.asked[-1].values == [4, 5]
            outcomes = await calls.answer_all()
            assert values_of(outcomes) == [100, 101, 0, 1, 2, 3, 4, 5]
            assert [task.result().model_version for task in waiting] == ["1"] * 6  # type: ignore[union-attr]

    run(ask)


def test_nothing_waits_long_for_a_request_to_end() -> None:
    async def ask() -> None:
        async with Calls() as calls:
            await calls.fill()
            await calls.begin(*map(sample_of, range(6)))
            await until(lambda: sum(len(asked.values) for asked in calls.asked) == LIMIT + 6)
            assert all(not asked.gate.done() for asked in calls.asked)
            assert len(calls.asked) < LIMIT + 6
            assert values_of(await calls.answer_all()) == [100, 101, *range(6)]

    run(ask)


@pytest.mark.parametrize(("instances", "num_servers", "limit"), [(1, 1, 2), (3, 1, 6), (1, 2, 4), (0, 1, 2)])
@pytest.mark.usefixtures("patient")
def test_two_requests_an_instance_of_each_server_go_at_once(instances: int, num_servers: int, limit: int) -> None:
    async def ask() -> None:
        stands = [Stand(f"grpc://{number}:1", instances=instances) for number in range(num_servers)]
        async with Calls(*stands) as calls:
            await calls.begin(*map(sample_of, range(limit + 3)))
            assert [len(asked.values) for asked in calls.asked] == [1] * limit
            assert {len(stand.asked) for stand in stands} == {limit // num_servers}
            assert values_of(await calls.answer_all()) == list(range(limit + 3))
            assert len(calls.asked) < limit + 3

    run(ask)


@pytest.mark.usefixtures("patient")
def test_all_types_of_samples_share_a_request_and_it_asks_for_their_scores() -> None:
    async def ask() -> None:
        one, other = sample_of(5).trajectory, sample_of(6, 2).trajectory
        async with Calls() as calls:
            await calls.begin(PreferenceSample(one, other), SimilaritySample(one, other))
            await calls.begin(PreferenceSample(one, other), SimilaritySample(one, other), sample_of(1), sample_of(2))
            preference, similarity, *_ = await calls.answer_all()
            assert list(calls.asked[0].outputs) == [wire.PROGRESS, wire.SUCCESS, wire.PREFERENCE]
            assert list(calls.asked[1].outputs) == [wire.PROGRESS, wire.SUCCESS, wire.SIMILARITY]
            assert [len(asked.values) for asked in calls.asked] == [1, 1, 3, 1]
            assert list(calls.asked[2].outputs) == [wire.PROGRESS, wire.SUCCESS, wire.PREFERENCE, wire.SIMILARITY]
            assert list(calls.asked[3].outputs) == [wire.PROGRESS, wire.SUCCESS]
            assert preference.second.progress.tolist() == [6, 6]  # type: ignore[union-attr]
            assert similarity.similarity == 5  # type: ignore[union-attr]

    run(ask)


WIDE = ProgressSample(Trajectory(video_embeddings=np.ones((3, 5)), text_embedding=np.ones(2)))
UNLIKE: dict[str, tuple[Sample, dict[str, Any]]] = {
    "named": (sample_of(1), {"request_id": "mine"}),
    "with timing": (sample_of(1), {"timing": True}),
    "with another time limit": (sample_of(1), {"timeout_s": 500.0}),
    "of another width": (WIDE, {}),
    "of raw frames": (ProgressSample(Trajectory(frames=np.zeros((2, 8, 8, 3), np.uint8), task="lift")), {}),
}


@pytest.mark.parametrize(("sample", "options"), UNLIKE.values(), ids=UNLIKE)
@pytest.mark.usefixtures("patient")
def test_unlike_calls_do_not_share(sample: Sample, options: dict[str, Any]) -> None:
    async def ask() -> None:
        async with Calls() as calls:
            await calls.fill()
            await calls.begin(sample_of(1), sample_of(2))
            assert len(calls.asked) == LIMIT
            await calls.begin(sample, **options)
            assert len(calls.asked) == LIMIT + 1
            assert len(calls.asked[-1].inputs[wire.SAMPLE_TYPE]) == 1

    run(ask)


@pytest.mark.parametrize("options", [{"join": False}, {}], ids=["switched off", "limits unknown"])
def test_nothing_is_joined_if(options: dict[str, Any]) -> None:
    async def ask() -> None:
        stand = Stand(info_error=None if options else ModelNotFoundError("no configuration"))
        async with Calls(stand, **options) as calls:
            for _ in range(3):
                await calls.begin(*map(sample_of, range(10)))
            assert [len(asked.values) for asked in calls.asked] == [1] * 30
            assert values_of(await calls.answer_all()) == [*range(10)] * 3
            assert stand.num_infos == (1 if options else 2)  # asked by the test, and not again and again

    run(ask)


def test_a_caller_who_is_alone_never_asks_for_the_limits() -> None:
    async def ask() -> None:
        stand = Stand(is_open=True)
        async with AsyncRewardClient("", transports=[stand], join=True) as client:
            for value in range(5):
                await client.score(sample_of(value))
            assert stand.num_infos == 0
            stand.is_open = False
            calls = asyncio.gather(*(client.score(sample_of(value)) for value in range(5)))
            await until(lambda: len(stand.waiting) == 5 and stand.num_infos == 1)
            for asked in stand.waiting:
                asked.answer()
            assert values_of(await calls) == [0, 1, 2, 3, 4]

    run(ask)


@pytest.mark.usefixtures("patient")
def test_a_request_has_as_many_samples_as_the_server_takes() -> None:
    async def ask() -> None:
        async with Calls(Stand(max_batch_size=3)) as calls:
            await calls.fill()
            await calls.begin(*map(sample_of, range(10)))
            assert values_of(await calls.answer_all()) == [100, 101, *range(10)]
            assert max(len(asked.values) for asked in calls.asked) == 3

    run(ask)


SIZES: dict[str, tuple[list[int], int, int]] = {
    "all": ([10, 20, 30], 64, 3),
    "as many as may be": ([10] * 5, 3, 3),
    "one at least": ([2 * MAX_REQUEST_BYTES], 64, 1),
    "large ones alone": ([MAX_REQUEST_BYTES // 2 + 1] * 3, 64, 1),
    "two of half the size": ([MAX_REQUEST_BYTES // 2] * 3, 64, 2),
    "a long one after short ones": ([1000] * 8 + [100_000], 64, 8),
    "a long one before short ones": ([200_000] + [1000] * 8, 64, 2),
    "little padding": ([100_000, 60_000, 90_000], 64, 3),
    "padding of few bytes": ([1000, 10, 10, 10], 64, 4),
}


@pytest.mark.parametrize(("sizes", "most", "count"), SIZES.values(), ids=SIZES)
def test_the_first_samples_go_together_if_that_is_not_mostly_padding(sizes: list[int], most: int, count: int) -> None:
    assert num_together(sizes, most) == count


@pytest.mark.usefixtures("patient")
def test_a_bad_sample_fails_alone() -> None:
    async def ask() -> None:
        async with Calls() as calls:
            await calls.fill()
            tasks = await calls.begin(sample_of(1), sample_of(BAD), sample_of(2), sample_of(3), sample_of(4))
            await calls.answer_all()
            outcomes = [task.exception() or task.result() for task in tasks]
            assert values_of(outcomes) == [1, None, 2, 3, 4]
            assert isinstance(outcomes[1], InvalidSampleError)
            assert outcomes[1].message == "video_embeddings: expected good ones, got bad ones"
            assert outcomes[1].request_id in [asked.request_id for asked in calls.asked if asked.values == [BAD]]

    run(ask)


@pytest.mark.usefixtures("patient")
def test_samples_whose_request_fails_are_asked_about_alone() -> None:
    async def ask() -> None:
        async with Calls() as calls:
            await calls.fill()
            tasks = await calls.begin(*map(sample_of, range(3)))
            calls.asked[0].answer()
            await until(lambda: len(calls.asked) == LIMIT + 1)
            calls.asked[-1].fail(InferenceFailedError("scoring failed; the server's log has the reason"))
            await calls.answer_all()
            assert values_of([task.result() for task in tasks]) == [0, 1, 2]
            assert [asked.values for asked in calls.asked[LIMIT:]] == [[0, 1], [0], [1], [2]]

    run(ask)


@pytest.mark.parametrize(
    "error", [ServerUnavailableError("it is down"), ModelNotFoundError("it is gone")], ids=lambda error: str(error)
)
@pytest.mark.usefixtures("patient")
def test_what_fails_whole_is_each_caller_s_own_error(error: RewardError) -> None:
    async def ask() -> None:
        async with Calls(retry=False) as calls:
            await calls.fill()
            tasks = await calls.begin(*map(sample_of, range(3)))
            calls.asked[0].answer()
            await until(lambda: len(calls.asked) == LIMIT + 1)
            assert calls.asked[-1].values == [0, 1]
            calls.asked[-1].fail(error)
            await calls.answer_all()
            errors = [task.exception() for task in tasks[:2]]
            assert [type(one) for one in errors] == [type(error)] * 2
            assert errors[0] is not errors[1]
            assert {one.request_id for one in errors} == {calls.asked[LIMIT].request_id}  # type: ignore[union-attr]
            assert values_of([tasks[2].result()]) == [2]

    run(ask)


@pytest.mark.usefixtures("patient")
def test_an_error_that_nobody_expected_reaches_each_caller() -> None:
    async def ask() -> None:
        async with Calls() as calls:
            await calls.fill()
            tasks = await calls.begin(*map(sample_of, range(2)))
            calls.asked[0].answer()
            await until(lambda: len(calls.asked) == LIMIT + 1)
            calls.asked[-1].fail(ZeroDivisionError("a fault in here"))
            await calls.answer_all()
            assert [type(task.exception()) for task in tasks] == [ZeroDivisionError] * 2

    run(ask)


@pytest.mark.usefixtures("patient")
def test_a_caller_whose_time_is_up_costs_the_others_nothing(clock: Clock) -> None:
    async def ask() -> None:
        async with Calls() as calls:
            await calls.begin(*(sample_of(100 + number) for number in range(LIMIT)), timeout_s=31)
            (hurried,) = await calls.begin(sample_of(1), timeout_s=16)
            (patient, _) = await calls.begin(sample_of(2), sample_of(3), timeout_s=31)
            calls.asked[0].answer()
            await until(lambda: len(calls.asked) == LIMIT + 1)
            assert calls.asked[-1].values == [1, 2]
            assert calls.asked[-1].timeout_s > 16  # the longest of its callers'
            clock.advance(17)
            with pytest.raises(DeadlineExceededError, match=r"^grpc://stand:1: no answer within 16 s$"):
                await hurried
            calls.asked[-1].answer()
            assert values_of([await patient]) == [2]

    run(ask)


@pytest.mark.parametrize("how", ["late", "cancelled"])
@pytest.mark.usefixtures("patient")
def test_a_sample_that_nobody_waits_for_any_more_is_not_sent(clock: Clock, how: str) -> None:
    async def ask() -> None:
        async with Calls() as calls:
            await calls.begin(*(sample_of(100 + number) for number in range(LIMIT)), timeout_s=31)
            (gone,) = await calls.begin(sample_of(1), timeout_s=16)
            others = await calls.begin(sample_of(2), sample_of(3), timeout_s=31)
            if how == "late":
                clock.advance(17)
            else:
                gone.cancel()
            await asyncio.wait({gone})
            await calls.answer_all()
            assert values_of([await other for other in others]) == [2, 3]
            assert 1.0 not in [value for asked in calls.asked for value in asked.values]

    run(ask)


@pytest.mark.usefixtures("patient")
def test_a_joint_request_is_cancelled_when_all_its_callers_are_gone() -> None:
    async def ask() -> None:
        async with Calls() as calls:
            await calls.fill()
            first, second, _third = await calls.begin(sample_of(1), sample_of(2), sample_of(3))
            calls.asked[0].answer()
            await until(lambda: len(calls.asked) == LIMIT + 1)
            joint = calls.asked[-1]
            assert joint.values == [1, 2]
            first.cancel()
            await asyncio.gather(first, return_exceptions=True)
            await calls.begin()
            assert not joint.is_cancelled
            second.cancel()
            await until(lambda: joint.is_cancelled)
            await until(lambda: len(calls.asked) == LIMIT + 2)  # its place is the next one's
            assert calls.asked[-1].values == [3]

    run(ask)


@pytest.mark.usefixtures("patient")
def test_a_server_that_hangs_is_left_out_after_a_joint_request(clock: Clock) -> None:
    async def ask() -> None:
        hung, good = Stand("grpc://hung:1"), Stand("grpc://good:1")
        async with Calls(hung, good) as calls:
            await calls.begin(*map(sample_of, range(2 * LIMIT)))
            await calls.begin(sample_of(7), sample_of(8), timeout_s=60)
            hung.asked[0].answer()
            await until(lambda: len(hung.asked) == LIMIT + 1)
            assert hung.asked[-1].values == [7, 8]
            for asked in (*hung.asked[:-1], *good.asked):
                if not asked.gate.done():
                    asked.answer()
            await asyncio.wait(calls.tasks[: 2 * LIMIT])
            clock.advance(61)
            outcomes = await asyncio.gather(*calls.tasks, return_exceptions=True)
            assert values_of(outcomes) == [0, 1, 2, 3, None, None]
            assert {type(outcome) for outcome in outcomes[-2:]} == {DeadlineExceededError}
            servers = {server.transport.url: server for server in calls.client._servers._servers}
            await until(lambda: servers["grpc://hung:1"].failures == 1)
            assert servers["grpc://good:1"].failures == 0

    asyncio.run(ask())


@pytest.mark.parametrize("num_servers", [1, 2])
@pytest.mark.usefixtures("patient")
def test_where_a_process_ends_samples_are_asked_about_apart(num_servers: int) -> None:
    async def ask() -> None:
        stands = [Stand(f"grpc://{number}:1") for number in range(num_servers)]
        async with Calls(*stands) as calls:
            limit = LIMIT * num_servers
            await calls.begin(*(sample_of(100 + number) for number in range(limit)))
            tasks = await calls.begin(*map(sample_of, range(8)))
            stands[0].asked[0].answer()
            await until(lambda: len(calls.asked) == limit + 1)
            joint = next(asked for asked in calls.asked if len(asked.values) > 1)
            before = len(calls.asked)
            joint.fail(ProcessEndedError("Stub process 'rfm_0_0' is not healthy."))
            await until(lambda: len(calls.asked) > before)
            await calls.answer_all()
            assert values_of([task.result() for task in tasks]) == list(range(8))
            assert [asked for asked in calls.asked if len(asked.values) > 1] == [joint]  # and nothing later is joined

    run(ask)


@pytest.mark.usefixtures("patient")
def test_closing_ends_those_that_wait() -> None:
    async def ask() -> None:
        calls = Calls()
        async with calls:
            await calls.fill()
            tasks = await calls.begin(*map(sample_of, range(5)))
        assert all(task.cancelled() for task in tasks)
        for _ in range(20):
            await asyncio.sleep(0)
        assert asyncio.all_tasks() == {asyncio.current_task()}

    asyncio.run(ask())


# How much is under way


async def entered(room: Any, order: list[int], number: int, leave: asyncio.Event) -> None:
    async with room:
        order.append(number)
        await leave.wait()


def test_room_is_given_in_the_order_in_which_it_was_asked_for() -> None:
    async def ask() -> None:
        room, order, leave = InFlight(1).room, list[int](), [asyncio.Event() for _ in range(5)]
        tasks = [asyncio.create_task(entered(room(0, Deadline(60)), order, n, leave[n])) for n in range(5)]
        await until(lambda: order == [0])
        tasks[1].cancel()
        await asyncio.wait({tasks[1]})
        leave[0].set()
        await until(lambda: order == [0, 2])
        leave[2].set()
        tasks[3].cancel()  # its turn comes, and it is cancelled before it knows
        leave[4].set()
        await asyncio.wait(tasks, timeout=WITHIN_S)
        assert order == [0, 2, 4]
        async with room(0, Deadline(1)):  # nothing was lost
            pass

    run(ask)


# A real server


def asked_by_tasks(url: str, samples: Sequence[Sample], **options: Any) -> list[Result | BaseException]:
    async def ask() -> list[Result | BaseException]:
        async with AsyncRewardClient(url, model=MODEL, **{"join": True, **options}) as client:
            await client.model_info()
            calls: list[Awaitable[Result]] = [client.score(sample) for sample in samples]
            return await asyncio.gather(*calls, return_exceptions=True)

    return asyncio.run(ask())


def asked_by_threads(url: str, samples: Sequence[Sample], **options: Any) -> list[Result | BaseException]:
    with RewardClient(url, model=MODEL, **{"join": True, **options}) as client, ThreadPoolExecutor(32) as pool:
        client.model_info()

        def ask(sample: Sample) -> Result | BaseException:
            return client.evaluate([sample], return_errors=True)[0]

        return list(pool.map(ask, samples))


def asked_by_futures(url: str, samples: Sequence[Sample], **options: Any) -> list[Result | BaseException]:
    with RewardClient(url, model=MODEL, **{"join": True, **options}) as client:
        client.model_info()
        futures = [client.submit(sample) for sample in samples]  # type: ignore[call-overload]
        return [future.exception() or future.result() for future in futures]


STYLES = [asked_by_tasks, asked_by_threads, asked_by_futures]


@pytest.mark.parametrize("style", STYLES, ids=lambda style: str(style.__name__))
def test_joined_calls_give_the_answers_of_calls_apart_with_fewer_requests(
    served: Served, protocol: str, style: Callable[..., list[Result | BaseException]]
) -> None:
    samples = mixed_samples(150)
    samples[40:40] = [ProgressSample(random_trajectory(0, 20))]  # longer than the checkpoint takes
    num_before = counts(served, MODEL)[0]
    joined = style(served.url(protocol), samples)
    num_joined = counts(served, MODEL)[0] - num_before
    apart = style(served.url(protocol), samples, join=False)
    # Triton counts the one that is refused as a success if it is refused later than ``execute`` returns.
    assert counts(served, MODEL)[0] - num_before - num_joined in (150, 151)
    assert num_joined < 120
    for index, (one, other) in enumerate(zip(joined, apart, strict=True)):
        if index == 40:
            assert isinstance(one, InvalidSampleError)
            assert isinstance(other, InvalidSampleError)
            assert one.message == other.message
            assert "num_frames: expected at most 16" in one.message
        else:
            assert_same(one, other)


INSTANCE_GROUPS: dict[str, tuple[list[dict[str, Any]], int]] = {
    "on the CPU": ([{"count": 3, "kind": "KIND_CPU", "gpus": []}], 3),
    "on each of two GPUs": ([{"count": 2, "kind": "KIND_GPU", "gpus": [0, 1]}], 4),
    "in two groups": ([{"count": 1, "gpus": [0]}, {"count": 2}], 3),
    "an ensemble": ([], 0),
}


@pytest.mark.parametrize(("groups", "instances"), INSTANCE_GROUPS.values(), ids=INSTANCE_GROUPS)
def test_instances_are_counted_on_every_device(groups: list[dict[str, Any]], instances: int) -> None:
    config = {"name": "rfm", "max_batch_size": 8, "input": [], "output": [], "instance_group": groups}
    assert ModelInfo.from_config(config).instances == instances


def test_a_server_tells_how_many_instances_it_has(served: Served, protocol: str) -> None:
    with served.client(protocol) as client:
        assert client.model_info().instances == 1
