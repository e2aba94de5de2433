# SPDX-License-Identifier: MIT
"""Several real servers of one checkpoint: a request that ends its process, and a name of several addresses."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from faulty_servers import url_of
from one_model import OneModelServer, answered
from patients import DEADLY, MARK, Callers, make_repository, references, trajectory
from rfm.launch.process import Endpoints
from rfm_client import (
    AsyncRewardClient,
    ProcessEndedError,
    ProgressResult,
    ProgressSample,
    RewardClient,
    RewardError,
)
from rfm_client.transport import host_names as names
from rfm_serve import MODEL, PATIENCE_S, Serving, model_processes, serving, wait_for

pytestmark = [pytest.mark.triton, pytest.mark.slow]

__all__ = ["references"]  # a fixture

POISON = trajectory(99, mark=MARK)
NUM_SERVERS = 3
LONG_S = 4 * PATIENCE_S  # so that a machine that is slow to heal a model decides nothing
NAME = "rfm-servers.test"


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[list[Serving]]:
    """Servers that heal themselves, each with a model that ends its process on a marked sample."""
    with ExitStack() as stack:
        folders = [tmp_path / f"server-{number}" for number in range(NUM_SERVERS)]
        served = [stack.enter_context(serving(make_repository(folder, more_code=DEADLY))) for folder in folders]
        for server in served:
            server.wait_ready(True, LONG_S)
        yield served
        for server in served:
            server.process.terminate()  # side by side: each takes seconds


def test_a_request_that_ends_its_process_ends_two_of_a_fleet(
    fleet: list[Serving], references: list[np.ndarray[Any, Any]], protocol: str
) -> None:
    urls = [url_of(server.endpoints, protocol) for server in fleet]
    with (
        RewardClient(urls, timeout_s=LONG_S) as client,
        RewardClient(urls, timeout_s=LONG_S) as other,
        Callers(client, references) as callers,
    ):
        callers.wait_for_all()
        # In one request with two others, which fail with it, and by another client beside those that are answered.
        batch = [ProgressSample(sample) for sample in (trajectory(0), POISON, trajectory(1))]
        outcomes = other.evaluate(batch, return_errors=True)
        assert all("ended under this request twice" in str(outcome) for outcome in outcomes), outcomes
        for server in fleet:
            server.wait_ready(True, LONG_S)
        assert sum(server.metric("rfm_serve_restarts_total", what=MODEL) for server in fleet) == 2
        lost = len(callers.lost)
        callers.wait_for_all()
    assert callers.wrong == []
    # Who was in one batch with it twice is lost, too.
    assert all("ended under this request twice" in str(error) for error in callers.lost)
    assert len(callers.lost) == lost < len(callers.answered)


def test_where_nothing_heals_a_request_ends_two_processes_and_others_are_answered(tmp_path: Path) -> None:
    with ExitStack() as stack:
        repositories = [
            make_repository(tmp_path / f"server-{number}", more_code=DEADLY) for number in range(NUM_SERVERS)
        ]
        servers = [stack.enter_context(OneModelServer(each, Endpoints.free())) for each in repositories]
        client = stack.enter_context(RewardClient([server.endpoints.grpc_url for server in servers]))
        with pytest.raises(ProcessEndedError, match="ended under this request twice"):
            client.progress(POISON)
        assert [bool(model_processes(server.pid)) for server in servers].count(False) == 2
        assert isinstance(client.progress(trajectory(0)), ProgressResult)


# A name of several addresses


class Names:
    """Answers for ``NAME``. The look-up alone is faked: no name of several addresses can be had without a DNS server."""

    def __init__(self, *hosts: str) -> None:
        self.hosts = hosts
        self.error: OSError | None = None
        self.num_asked = 0
        self._real = socket.getaddrinfo

    def __call__(self, host: Any, port: Any, *rest: Any, **options: Any) -> Any:
        if host != NAME:
            return self._real(host, port, *rest, **options)
        self.num_asked += 1
        if self.error is not None:
            raise self.error
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, port)) for address in self.hosts]


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> Names:
    """Looked up as often as a call is made."""
    found = Names()
    monkeypatch.setattr(socket, "getaddrinfo", found)
    monkeypatch.setattr("rfm_client.transport.servers.REFRESH_S", 0.0)
    return found


@pytest.mark.parametrize("url", [f"grpc://{NAME}:%d", f"dns:///{NAME}:%d"])
def test_servers_behind_one_name_share_the_calls_and_those_that_are_added_join(
    tmp_path: Path, found: Names, url: str
) -> None:
    first = Endpoints.free()
    places = [first, *(replace(first, host=f"127.0.0.{number}") for number in (2, 3))]

    running: list[Endpoints] = []
    num_asked = 0  # by this test, and by Triton at each start: the warm-up

    def ask() -> ProgressResult:
        nonlocal num_asked
        num_asked += 1
        return client.progress(trajectory(0))

    def counts() -> list[int]:
        """How many calls each has answered. Triton counts one after it has sent the answer."""
        wait_for(lambda: sum(map(answered, running)) == num_asked)
        return [answered(place) for place in running]

    def shares(num_new: int) -> list[int]:
        """How many of so many new calls each answers."""
        before = counts()
        for _ in range(num_new):
            ask()
        return [after - count for after, count in zip(counts(), before, strict=True)]

    with ExitStack() as stack:
        client = stack.enter_context(RewardClient(url % first.grpc_port, shared_memory=True))
        for place in places:
            stack.enter_context(OneModelServer(make_repository(tmp_path / place.host), place))
            running.append(place)
            num_asked += answered(place)
            found.hosts = tuple(one.host for one in running)
            if len(running) > 1:  # of one address gRPC looks the name up itself, which is not faked
                wait_for(lambda: shares(len(running)) == [1] * len(running))
        # One that is taken away is asked no more, and an error of the look-up changes nothing.
        found.hosts = found.hosts[:2]
        asked = found.num_asked
        wait_for(lambda: ask() and found.num_asked > asked + 1)
        found.error = socket.gaierror("no answer")
        assert shares(6) == [3, 3, 0]


def test_a_server_that_is_looked_up_is_known_by_its_name() -> None:
    made: list[tuple[str, str | None]] = []

    def connect(url: str, *, named: str | None = None) -> Any:
        made.append((url, named))
        return object()

    async def look_up() -> None:
        name = names.Name("grpcs://localhost:8001", connect)
        await name.look_up()
        assert list(name.transports) == [""]

    asyncio.run(look_up())
    assert made == [("grpcs://localhost:8001", None)]


@pytest.mark.parametrize(
    ("url", "is_name"),
    [
        ("grpc://rfm-triton-pods:8001", True),
        ("grpcs://rfm-triton-pods:8001", True),
        ("dns:///rfm-triton-pods:8001", True),
        ("http://rfm-triton-pods:8000", False),
        ("grpc://localhost:8001", False),
        ("grpc://127.0.0.1:8001", False),
        ("grpc://[::1]:8001", False),
    ],
)
def test_which_url_may_stand_for_several_servers(url: str, is_name: bool) -> None:
    assert names.is_name(url) is is_name


def test_a_client_of_a_name_that_nobody_knows_says_so(found: Names) -> None:
    found.error = socket.gaierror("no such name")

    async def ask() -> None:
        async with AsyncRewardClient("grpc://rfm-servers.invalid:8001", retry=False) as client:
            await client.progress(trajectory(0))

    with pytest.raises(RewardError, match=r"resol|DNS"):
        asyncio.run(ask())
