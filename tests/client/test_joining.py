# SPDX-License-Identifier: MIT
"""Concurrent calls that share requests, at a server that stands in and answers when it is told to."""

from __future__ import annotations

import asyncio
from copy import copy
from typing import Any

import numpy as np
import pytest

from rfm_client import (
    AsyncRewardClient,
    DeadlineExceededError,
    InferenceFailedError,
    InvalidSampleError,
    ModelNotFoundError,
    PreferenceSample,
    ProcessEndedError,
    ProgressSample,
    RewardError,
    Sample,
    ServerUnavailableError,
    SimilaritySample,
    Trajectory,
)
from rfm_client.batching import MAX_REQUEST_BYTES, num_together
from rfm_client.contract import wire
from rfm_client.transport.deadline import Deadline
from rfm_client.transport.in_flight import InFlight
from stand_ins import BAD, LIMIT, WITHIN_S, Calls, Clock, Stand, run, sample_of, until, values_of


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


LOST = ServerUnavailableError("Stream removed (Socket closed)")
LOST.may_have_ended_server = True
ENDED = [ProcessEndedError("Stub process 'rfm_0_0' is not healthy."), LOST]


@pytest.mark.parametrize("ended", ENDED, ids=["process", "connection"])
@pytest.mark.parametrize("num_servers", [1, 2])
@pytest.mark.usefixtures("patient")
def test_where_a_process_ends_samples_are_asked_about_apart(num_servers: int, ended: ServerUnavailableError) -> None:
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
            joint.fail(copy(ended))
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
