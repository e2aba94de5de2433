# SPDX-License-Identifier: MIT
"""Servers that stop, hang and come back, and connections that die."""

from __future__ import annotations

import shutil
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from faulty_servers import heavy, ours_in_dev_shm, trajectory, url_of
from mixtures import assert_same
from one_model import OneModelServer, answered
from proxies import Proxy
from repositories import bound_queue, configure
from rfm.launch.process import Endpoints
from rfm_client import (
    DeadlineExceededError,
    ProgressResult,
    ProgressSample,
    Result,
    RewardClient,
    ServerUnavailableError,
)

pytestmark = [pytest.mark.triton, pytest.mark.slow]


PATIENCE_S = 60.0


class Outcomes:
    """What came of the calls of several threads."""

    def __init__(self) -> None:
        self._all: list[Result | Exception] = []
        self._changed = threading.Condition()

    def append(self, outcome: Result | Exception) -> None:
        with self._changed:
            self._all.append(outcome)
            self._changed.notify_all()

    def wait_for(self, kind: type, count: int = 20) -> None:
        """Returns when ``count`` more of that kind have come."""
        with self._changed:
            start = len(self._all)
            enough = lambda: sum(isinstance(outcome, kind) for outcome in self._all[start:]) >= count  # noqa: E731
            assert self._changed.wait_for(enough, PATIENCE_S)

    @property
    def errors(self) -> list[Exception]:
        return [outcome for outcome in self._all if isinstance(outcome, Exception)]


@contextmanager
def calling(client: RewardClient, threads: int = 4) -> Iterator[Outcomes]:
    """Within it, threads ask without pause."""
    outcomes = Outcomes()
    stop = threading.Event()

    def ask(seed: int) -> None:
        while not stop.is_set():
            try:
                outcomes.append(client.progress(trajectory(seed)))
            except Exception as error:  # noqa: BLE001  whatever it is, the test looks at it
                outcomes.append(error)

    with ThreadPoolExecutor(threads) as pool:
        running = [pool.submit(ask, seed) for seed in range(threads)]
        try:
            yield outcomes
        finally:
            stop.set()
            for thread in running:
                thread.result()


def test_calls_survive_a_restart_of_the_server(repository: Path, protocol: str) -> None:
    endpoints = Endpoints.free()
    with ExitStack() as servers, RewardClient(url_of(endpoints, protocol), timeout_s=PATIENCE_S) as client:
        server = servers.enter_context(OneModelServer(repository, endpoints))
        expected = client.progress(trajectory(0))
        with calling(client) as outcomes:
            outcomes.wait_for(ProgressResult)
            server.stop()
            servers.enter_context(OneModelServer(repository, endpoints))
            outcomes.wait_for(ProgressResult)
        assert outcomes.errors == []
        assert_same(expected, client.progress(trajectory(0)))


def test_of_two_servers_one_may_be_killed_and_come_back(tmp_path: Path, repository: Path, protocol: str) -> None:
    both = [Endpoints.free(), Endpoints.free()]
    other_repository = shutil.copytree(repository, tmp_path / "other" / "model_repository")
    urls = [url_of(endpoints, protocol) for endpoints in both]
    with ExitStack() as servers, RewardClient(urls, timeout_s=PATIENCE_S) as client:
        first = servers.enter_context(OneModelServer(repository, both[0]))
        servers.enter_context(OneModelServer(other_repository, both[1]))
        with calling(client) as outcomes:
            until(lambda: all(answered(endpoints) for endpoints in both))  # the load is shared
            first.kill()
            outcomes.wait_for(ProgressResult, 100)
            servers.enter_context(OneModelServer(repository, both[0]))
            until(lambda: answered(both[0]) > 0)  # it is asked again
        assert outcomes.errors == []


def until(condition: Callable[[], bool]) -> None:
    """Asks the servers again and again."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s


def test_a_server_that_hangs_costs_one_call_and_is_left_out(repository: Path, protocol: str) -> None:
    endpoints = Endpoints.free()
    with OneModelServer(repository, endpoints), socket.create_server(("127.0.0.1", 0)) as hung:
        urls = [f"{protocol}://127.0.0.1:{hung.getsockname()[1]}", url_of(endpoints, protocol)]
        with RewardClient(urls, timeout_s=2) as client:
            client.wait_ready(30)  # the one that is ready is enough
            outcomes: list[Result | Exception] = []
            for _ in range(6):
                outcomes += client.evaluate([ProgressSample(trajectory(0))], return_errors=True)
    assert [type(outcome) for outcome in outcomes if isinstance(outcome, Exception)] == [DeadlineExceededError]


def test_a_connection_that_dies_in_silence_costs_one_deadline(repository: Path, protocol: str) -> None:
    endpoints = Endpoints.free()
    port = endpoints.grpc_port if protocol == "grpc" else endpoints.http_port
    with (
        OneModelServer(repository, endpoints),
        Proxy(port) as proxy,
        RewardClient(f"{protocol}://127.0.0.1:{proxy.port}", timeout_s=3) as client,
    ):
        expected = client.progress(trajectory(0), timeout_s=PATIENCE_S)
        proxy.go_silent()
        outcomes = [client.evaluate([ProgressSample(trajectory(0))], return_errors=True)[0] for _ in range(5)]
        assert [type(outcome) for outcome in outcomes] == [DeadlineExceededError, *[ProgressResult] * 4]
        assert_same(expected, outcomes[-1])
        assert proxy.num_connections == 2


def test_a_request_that_nobody_takes_goes_over_a_new_connection_within_its_time(repository: Path) -> None:
    endpoints = Endpoints.free()
    large = trajectory(0, 40_000)  # 10 MB: more than the sockets' buffers take
    with (
        OneModelServer(repository, endpoints),
        Proxy(endpoints.grpc_port, reads=False) as proxy,
        RewardClient(f"grpc://127.0.0.1:{proxy.port}", timeout_s=PATIENCE_S) as client,
    ):
        expected = client.progress(trajectory(0))
        proxy.go_silent()
        assert client.progress(large, frame_steps=2).progress.shape == (40_000,)
        assert_same(expected, client.progress(trajectory(0)))
        assert proxy.num_connections == 2


def test_calls_that_share_a_connection_with_one_that_hits_its_deadline_go_on(repository: Path) -> None:
    """Over a connection that is alive and slow: a call that has more time keeps it."""
    endpoints = Endpoints.free()
    with (
        OneModelServer(repository, endpoints),
        Proxy(endpoints.grpc_port) as proxy,
        RewardClient(f"grpc://127.0.0.1:{proxy.port}") as client,
    ):
        expected = client.progress(trajectory(0))
        with proxy.held():
            patient = client.submit(ProgressSample(trajectory(0)), timeout_s=PATIENCE_S)
            with pytest.raises(DeadlineExceededError):
                client.progress(trajectory(0), timeout_s=2)
        assert_same(expected, patient.result())
        assert proxy.num_connections == 1


def test_a_server_that_hangs_does_not_hold_what_shares_memory_with_it(repository: Path) -> None:
    endpoints = Endpoints.free()
    before = ours_in_dev_shm()
    with OneModelServer(repository, endpoints) as server:
        client = RewardClient(endpoints.grpc_url, shared_memory=True)
        client.progress(heavy(), frame_steps=2)
        server.signal(signal.SIGSTOP)
        try:
            client.close()
        finally:
            server.signal(signal.SIGCONT)
        assert ours_in_dev_shm() == before


@pytest.fixture
def short_queue(repository: Path) -> Path:
    configure(repository / "rfm", batch_size=1)
    bound_queue(repository / "rfm", max_queue_size=1)
    return repository


def test_a_full_queue_is_waited_for(short_queue: Path, protocol: str) -> None:
    samples = [ProgressSample(trajectory(seed, 32), frame_steps=16) for seed in range(40)]
    endpoints = Endpoints.free()
    with OneModelServer(short_queue, endpoints):
        with RewardClient(url_of(endpoints, protocol), retry=False) as client:
            outcomes = client.evaluate(samples, return_errors=True)
        with RewardClient(url_of(endpoints, protocol), timeout_s=PATIENCE_S) as client:
            answers = client.evaluate(samples)
    refused = [outcome for outcome in outcomes if isinstance(outcome, Exception)]
    assert {type(error) for error in refused} == {ServerUnavailableError}
    assert "Exceeds maximum queue size" in str(refused[0])
    assert len(answers) == len(samples)
    for outcome, answer in zip(outcomes, answers, strict=True):
        if not isinstance(outcome, Exception):
            assert_same(outcome, answer)
