# SPDX-License-Identifier: MIT
"""Servers that change versions, and a server without the model. All are stand-ins."""

from __future__ import annotations

import asyncio
import re
import time
from collections import Counter
from collections.abc import Collection

import numpy as np
import pytest

from rfm_client import (
    AsyncRewardClient,
    DeadlineExceededError,
    InferenceFailedError,
    ModelInfo,
    ModelNotFoundError,
    ProgressResult,
    ProgressSample,
    RewardClient,
    RewardError,
    ServerUnavailableError,
)
from servers import wait_for
from trajectories import random_trajectory
from transports import Answer, Tensors

NUM_FRAMES = 4
SEEN = random_trajectory(0, NUM_FRAMES)
WITHIN_S = 30.0
LACKING = ModelNotFoundError("lacking")


class Stand:
    """Serves ``version``, or fails with ``error``."""

    def __init__(self, url: str = "grpc://stand:1", error: RewardError | None = None) -> None:
        self.url = url
        self.error = error
        self.num_ends = 0  # the connection ends during the next N requests
        self.down_s = 0.0  # for so long after each end it takes no connection
        self.is_silent = False  # accepts connections and never answers
        self.max_batch_size = 64
        self.sizes: list[int] = []  # samples per answered request
        self._up_s = 0.0
        self.version = 1
        self.weights_digest = "a" * 16
        self.asked: Counter[str] = Counter()

    async def infer(
        self, model: str, inputs: Tensors, outputs: Collection[str], timeout_s: float, *, request_id: str = ""
    ) -> Answer:
        self.asked["infer"] += 1
        if self.is_down:
            self.asked["while down"] += 1
            raise ServerUnavailableError("Connection refused")
        if self.is_silent:
            await asyncio.sleep(timeout_s)
            raise DeadlineExceededError("no answer in time")
        is_end = self.num_ends > 0
        self.num_ends -= is_end
        await asyncio.sleep(0.01)  # all come before the first ends
        if is_end:
            self.go_down(self.down_s)
            raise lost()
        if self.error is not None:
            raise self.error
        shape = len(inputs["num_frames"]), inputs["num_frames"].sum(axis=1).max()
        self.sizes.append(shape[0])
        tensors = {name: np.full(shape, 0.5, np.float32) for name in outputs}
        return Answer(tensors, str(self.version))

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        self.asked["model_info"] += 1
        if self.error is not None:
            raise self.error
        described = {"max_batch_size": self.max_batch_size, "weights_digest": self.weights_digest}
        return ModelInfo(name=model, versions=(str(self.version),), **described)

    async def is_ready(self, model: str, timeout_s: float) -> bool:
        return self.error is None and not (self.is_down or self.is_silent)

    async def close(self) -> None:
        pass

    def go_down(self, down_s: float) -> None:
        self._up_s = time.monotonic() + down_s

    @property
    def is_down(self) -> bool:
        return time.monotonic() < self._up_s


def lost() -> ServerUnavailableError:
    """Return the error of a call whose connection ends."""
    error = ServerUnavailableError("Socket closed")
    error.may_have_ended_server = True
    return error


def test_cached_model_info_is_dropped_when_another_version_answers() -> None:
    stand = Stand()
    with RewardClient("", transports=[stand]) as client:
        for _ in range(3):
            assert client.model_info().versions == ("1",)
            client.progress(SEEN)
        assert stand.asked["model_info"] == 1
        stand.version = 2
        assert client.model_info().versions == ("1",)
        assert client.model_info(refresh=True).versions == ("2",)
        stand.version = 1
        client.progress(SEEN)
        assert client.model_info().versions == ("1",)
        assert stand.asked["model_info"] == 3


def test_a_model_that_answered_before_and_is_missing_is_waited_for() -> None:
    stand = Stand(error=LACKING)
    with RewardClient("", transports=[stand]) as client:
        with pytest.raises(ModelNotFoundError):
            client.progress(SEEN)
        stand.error = None
        client.progress(SEEN)
        stand.error = LACKING
        with pytest.raises(ServerUnavailableError, match=r"^lacking: it answered before: .*: try again"):
            client.progress(SEEN, timeout_s=0.3)
        waiting = client.submit(ProgressSample(SEEN))
        wait_for(lambda: stand.asked["infer"] > 6)
        stand.error = None
        waiting.result()


def ask(stands: list[Stand], calls: int = 1, *, timeout_s: float = 4.0) -> list[object]:
    """Return the outcomes of concurrent calls."""

    async def outcomes() -> list[object]:
        async with AsyncRewardClient("", transports=stands, timeout_s=timeout_s) as client:
            return await asyncio.gather(*(client.progress(SEEN) for _ in range(calls)), return_exceptions=True)

    return asyncio.run(asyncio.wait_for(outcomes(), WITHIN_S))


def test_a_request_has_no_more_samples_than_a_batch() -> None:
    stand = Stand()
    stand.max_batch_size = 3
    with RewardClient("", transports=[stand]) as client:
        assert len(client.evaluate([ProgressSample(SEEN)] * 7)) == 7
    assert sorted(stand.sizes) == [1, 3, 3]


def test_pauses_double_and_half_of_each_is_random(monkeypatch: pytest.MonkeyPatch) -> None:
    """Callers of a server that is down would come back together without chance."""
    drawn: list[tuple[float, float]] = []

    def lowest(low: float, high: float) -> float:
        drawn.append((low, high))
        return low

    monkeypatch.setattr("random.uniform", lowest)
    stand = Stand()
    stand.go_down(0.3)
    assert kinds(ask([stand])) == {ProgressResult}
    assert drawn[:3] == [(0.05, 0.1), (0.1, 0.2), (0.2, 0.4)]


def test_an_outage_is_logged_once_when_it_begins_and_once_when_it_ends(caplog: pytest.LogCaptureFixture) -> None:
    stand = Stand("grpc://only:1")
    stand.go_down(0.3)
    assert kinds(ask([stand], 20)) == {ProgressResult}
    begun, ended = (record.message for record in caplog.records)
    assert begun == "grpc://only:1: trying again for up to 4 s: Connection refused"
    assert re.fullmatch(r"grpc://only:1: answers again after \d+\.\d s", ended)


def kinds(outcomes: list[object]) -> set[type]:
    return {type(outcome) for outcome in outcomes}


def test_a_server_that_lacks_the_model_is_left_out() -> None:
    lacking, good = Stand("grpc://lacking:1", LACKING), Stand("grpc://good:1")
    with RewardClient("", transports=[lacking, good]) as client:
        for _ in range(20):
            for future in [client.submit(ProgressSample(SEEN)) for _ in range(4)]:
                future.result()
    assert good.asked["infer"] == 80
    assert lacking.asked["infer"] <= 4  # of the first round


def test_a_server_that_hangs_costs_one_call_and_is_left_out() -> None:
    hung, good = Stand("grpc://hung:1"), Stand("grpc://good:1")
    hung.is_silent = True

    with RewardClient("", transports=[hung, good], timeout_s=0.2) as client:
        outcomes = [client.evaluate([ProgressSample(SEEN)], return_errors=True)[0] for _ in range(6)]
    assert [type(each) for each in outcomes if isinstance(each, Exception)] == [DeadlineExceededError]


class Flapping(Stand):
    """Fails, but every other probe finds it ready."""

    async def is_ready(self, model: str, timeout_s: float) -> bool:
        self.asked["is_ready"] += 1
        return self.asked["is_ready"] % 2 == 0


def test_a_server_that_fails_while_it_reports_ready_rests_longer_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rfm_client.transport.servers.FIRST_PAUSE_S", 0.4)
    flapping, good = Flapping("grpc://flapping:1", InferenceFailedError("it failed")), Stand("grpc://good:1")
    end_s = time.monotonic() + 1.5
    with RewardClient("", transports=[flapping, good]) as client:
        while time.monotonic() < end_s:
            client.progress(SEEN)
    assert 1 <= flapping.asked["infer"] <= 3  # after rests of at least 0.2 and 0.4 s, each with a pause between probes
    assert flapping.asked["is_ready"] <= 6


@pytest.mark.parametrize(
    ("others", "kind"),
    [
        ([LACKING, LACKING], ModelNotFoundError),
        ([LACKING, InferenceFailedError("it failed")], InferenceFailedError),
        ([LACKING, ServerUnavailableError("it is down")], ServerUnavailableError),
    ],
)
def test_a_model_is_not_served_only_if_every_server_says_so(others: list[RewardError], kind: type[RewardError]) -> None:
    stands = [Stand(f"grpc://{number}:1", error) for number, error in enumerate(others)]
    assert kinds(ask(stands, timeout_s=2.0)) == {kind}
    if kind is ModelNotFoundError:  # each was asked once, and none was left out for it
        assert [stand.asked["infer"] for stand in stands] == [1, 1]


@pytest.mark.slow
@pytest.mark.parametrize(("down_s", "kind"), [(0.1, DeadlineExceededError), (1.3, ServerUnavailableError)])
def test_a_call_out_of_time_raises_the_error_that_took_most_of_its_time(down_s: float, kind: type[RewardError]) -> None:
    """The server takes no connection at first, and is silent afterwards."""
    stand = Stand()
    stand.is_silent = True
    stand.go_down(down_s)
    assert kinds(ask([stand], timeout_s=2.0)) == {kind}


def test_calls_under_which_a_connection_ends_are_asked_once_more_of_another_server() -> None:
    one, other = Stand("grpc://one:1"), Stand("grpc://other:1")
    one.num_ends, one.down_s = 16, 60.0
    assert kinds(ask([one, other], 32)) == {ProgressResult}
    assert (one.asked["infer"], other.asked["infer"]) == (16, 32)


def test_a_call_waits_for_its_only_server_to_be_back() -> None:
    only = Stand()
    only.num_ends, only.down_s = 16, 0.5
    assert kinds(ask([only], 16)) == {ProgressResult}
    assert (only.asked["infer"], only.asked["while down"]) == (32, 0)


@pytest.mark.parametrize(("num_ends", "lull_s"), [(1, 60.0), (0, 0.0)], ids=["after a failure", "after a lull"])
def test_a_server_that_comes_back_with_another_checkpoint_is_reported(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, num_ends: int, lull_s: float
) -> None:
    monkeypatch.setattr("rfm_client.transport.servers.LULL_S", lull_s)
    stand = Stand()
    with RewardClient("", transports=[stand]) as client:
        assert client.model_info().weights_digest == "a" * 16
        for digest, told in (("a" * 16, 0), ("b" * 16, 1), ("b" * 16, 1)):
            stand.num_ends, stand.weights_digest = num_ends, digest
            client.progress(SEEN)
            assert caplog.text.count(f"another checkpoint, rfm (weights {'b' * 16}) instead of rfm") == told
        assert client.model_info().weights_digest == "b" * 16


def test_one_of_several_servers_that_comes_back_with_another_checkpoint_is_reported(
    caplog: pytest.LogCaptureFixture,
) -> None:
    stand, other = Stand("grpc://one:1"), Stand("grpc://other:1")
    with RewardClient("", transports=[stand, other]) as client:
        assert client.model_info().weights_digest == "a" * 16
        stand.num_ends, stand.weights_digest = 1, "b" * 16

        def has_told() -> bool:
            client.progress(SEEN)
            return f"another checkpoint, rfm (weights {'b' * 16}) instead of rfm" in caplog.text

        wait_for(has_told)


def test_after_a_lull_only_the_server_that_answers_is_described(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rfm_client.transport.servers.LULL_S", 0.0)
    stands = [Stand("grpc://one:1"), Stand("grpc://other:1")]
    with RewardClient("", transports=stands) as client:
        client.model_info()
        for _ in range(4):
            client.progress(SEEN)
    assert [stand.asked["infer"] for stand in stands] == [2, 2]
    assert [stand.asked["model_info"] for stand in stands] == [3, 2]


@pytest.mark.parametrize("num_servers", [1, 3])
def test_a_call_under_which_two_processes_end_fails(num_servers: int) -> None:
    stands = [Stand(f"grpc://{number}:1") for number in range(num_servers)]
    for stand in stands:
        stand.num_ends, stand.down_s = 10, 0.2
    (error,) = ask(stands)
    assert isinstance(error, ServerUnavailableError)
    assert "ended twice during this request: Socket closed" in str(error)
    assert sum(stand.asked["infer"] for stand in stands) == 2


def test_model_info_is_asked_of_another_server_at_once_if_one_is_lost() -> None:
    stands = [Stand("grpc://one:1", lost()), Stand("grpc://other:1")]
    with RewardClient("", transports=stands) as client:
        assert client.model_info().versions == ("1",)
