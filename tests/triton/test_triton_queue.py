# SPDX-License-Identifier: MIT
"""When Triton's queue is known to be empty, by a clock of the test's own."""

from __future__ import annotations

import math

import pytest

from clock import Clock
from rfm.triton_model import triton_queue
from rfm.triton_model.triton_queue import TritonQueue


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(triton_queue, "time", clock)
    return clock


def called(
    queue: TritonQueue,
    clock: Clock,
    after_s: float,
    *,
    num_requests: int = 1,
    num_bytes: int = 0,
    num_responses: int = 0,
) -> float:
    """How long the queue is unseen when ``execute``, which then takes a second, is called again."""
    clock.now_s += after_s
    queue.called(clock.now_s, num_requests, num_bytes)
    unseen_s = queue.unseen_s
    clock.now_s += 1.0
    queue.returned(num_responses)
    return unseen_s


def test_before_the_first_call_nothing_is_known(clock: Clock) -> None:
    assert TritonQueue().unseen_s == math.inf


def test_at_the_first_call_nothing_has_waited(clock: Clock) -> None:
    assert called(TritonQueue(), clock, 5.0) == 0.0


@pytest.mark.parametrize(
    ("num_responses", "num_requests", "num_bytes", "allowed_s"),
    [
        (0, 1, 0, 0.00125),  # 1 ms, and 0.25 ms for the request
        (3, 1, 0, 0.00325),  # 1 ms for each response
        (0, 5, 0, 0.00225),
        (2, 1, 20_000_000, 0.04225),  # 2 ms for each megabyte
    ],
)
def test_nothing_waited_if_two_calls_in_a_row_come_later_than_triton_needs(
    clock: Clock, num_responses: int, num_requests: int, num_bytes: int, allowed_s: float
) -> None:
    queue = TritonQueue()
    called(queue, clock, 5.0, num_responses=num_responses)

    def unseen_s(after_s: float) -> float:
        given = {"num_requests": num_requests, "num_bytes": num_bytes, "num_responses": num_responses}
        return called(queue, clock, after_s, **given)

    in_time_s, late_s = 0.9 * allowed_s, 1.1 * allowed_s
    assert unseen_s(in_time_s) == pytest.approx(1.0 + in_time_s)
    assert unseen_s(late_s) == pytest.approx(2.0 + in_time_s + late_s)  # the machine may have been busy
    assert unseen_s(in_time_s) == pytest.approx(3.0 + 2 * in_time_s + late_s)
    unseen_s(late_s)
    assert unseen_s(late_s) == 0.0
    assert unseen_s(late_s) == 0.0  # for as long as they are late
    assert unseen_s(in_time_s) > 0.0
    assert unseen_s(9.0 * allowed_s) > 0.0  # one call alone
    unseen_s(in_time_s)
    assert unseen_s(11.0 * allowed_s) == 0.0  # so late is no call that brings what has waited
