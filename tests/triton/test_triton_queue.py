# SPDX-License-Identifier: MIT
"""When Triton's queue is known to be empty, by a clock of the test's own."""

from __future__ import annotations

import math

import pytest

from clock import Clock
from rfm.triton_model import triton_queue
from rfm.triton_model.triton_queue import HAND_OVER_S, TritonQueue


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(triton_queue, "time", clock)
    return clock


def called(queue: TritonQueue, clock: Clock, after_s: float, num_responses: int) -> float:
    """How long the queue is unseen when ``execute``, which then takes a second, is called again."""
    clock.now_s += after_s
    queue.called()
    unseen_s = queue.unseen_s
    clock.now_s += 1.0
    queue.returned(num_responses)
    return unseen_s


def test_before_the_first_call_nothing_is_known(clock: Clock) -> None:
    assert TritonQueue().unseen_s == math.inf


def test_at_the_first_call_nothing_has_waited(clock: Clock) -> None:
    assert called(TritonQueue(), clock, 5.0, 0) == 0.0


@pytest.mark.parametrize(("num_responses", "allowed_s"), [(0, HAND_OVER_S), (1, HAND_OVER_S), (3, 3 * HAND_OVER_S)])
def test_what_comes_late_did_not_wait(clock: Clock, num_responses: int, allowed_s: float) -> None:
    queue = TritonQueue()
    called(queue, clock, 5.0, num_responses)
    assert called(queue, clock, 0.9 * allowed_s, num_responses) == pytest.approx(1.0 + 0.9 * allowed_s)
    assert called(queue, clock, 1.1 * allowed_s, num_responses) == 0.0
