# SPDX-License-Identifier: MIT
"""Dying connections, full queues, and shared memory."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace

import numpy as np
import pytest
import tritonclient.grpc
from tritonclient.utils import InferenceServerException

from callers import WIDTHS
from commands import in_shared_memory
from engine_server import EngineServer
from mixtures import MODEL, assert_same, plug, wait_until_at_work
from proxies import Proxy
from repositories import bound_queue, configure
from rfm_client import (
    DeadlineExceededError,
    ProgressResult,
    ProgressSample,
    RewardClient,
    ServerUnavailableError,
    Trajectory,
)
from rfm_client.contract.triton import LOST_REGION
from rfm_client.transport import limits, shared_memory
from rfm_client.transport.shared_memory import MIN_SHARED_BYTES, SharedMemory
from servers import PATIENCE_S, Endpoints, Served, start_triton
from trajectories import random_trajectory


def trajectory(seed: int, num_frames: int = 8) -> Trajectory:
    return random_trajectory(seed, num_frames, *WIDTHS)


def heavy() -> Trajectory:
    """Large enough for shared memory."""
    return trajectory(0, 2000)


def regions(endpoints: Endpoints) -> set[str]:
    """Return the names of the server's mapped regions."""
    with tritonclient.grpc.InferenceServerClient(endpoints.grpc_url.removeprefix("grpc://")) as client:
        return set(client.get_system_shared_memory_status().regions)


def ours_in_dev_shm() -> set[str]:
    return {name for name in in_shared_memory() if "rfm-client-" in name}


@pytest.fixture
def port(engines: EngineServer) -> int:
    """Of a server over gRPC that answers."""
    with engines.client("rfm") as client:
        client.wait_ready(PATIENCE_S)
    return int(engines.url.rpartition(":")[2])


@pytest.mark.slow
def test_a_connection_that_dies_in_silence_costs_one_deadline(port: int) -> None:
    with Proxy(port) as proxy, RewardClient(f"grpc://127.0.0.1:{proxy.port}", timeout_s=1.5) as client:
        expected = client.progress(trajectory(0), timeout_s=PATIENCE_S)
        proxy.go_silent()
        outcomes = [client.evaluate([ProgressSample(trajectory(0))], return_errors=True)[0] for _ in range(5)]
        assert [type(outcome) for outcome in outcomes] == [DeadlineExceededError, *[ProgressResult] * 4]
        assert_same(expected, outcomes[-1])
        assert proxy.num_connections == 2


@pytest.mark.slow
def test_a_request_that_the_server_does_not_take_goes_over_a_new_connection_within_its_time(port: int) -> None:
    large = trajectory(0, 40_000)  # 10 MB: more than the sockets' buffers take
    with (
        Proxy(port, reads=False) as proxy,
        RewardClient(f"grpc://127.0.0.1:{proxy.port}", timeout_s=PATIENCE_S) as client,
    ):
        expected = client.progress(trajectory(0))
        proxy.go_silent()
        assert client.progress(large, frame_steps=2).progress.shape == (40_000,)
        assert_same(expected, client.progress(trajectory(0)))
        assert proxy.num_connections == 2


def test_calls_that_share_a_connection_with_one_that_hits_its_deadline_go_on(port: int) -> None:
    """A slow connection stays open for calls with more time."""
    with Proxy(port) as proxy, RewardClient(f"grpc://127.0.0.1:{proxy.port}") as client:
        expected = client.progress(trajectory(0))
        with proxy.held():
            patient = client.submit(ProgressSample(trajectory(0)), timeout_s=PATIENCE_S)
            with pytest.raises(DeadlineExceededError):
                client.progress(trajectory(0), timeout_s=0.5)
        assert_same(expected, patient.result())
        assert proxy.num_connections == 1


@pytest.mark.slow
@pytest.mark.triton
def test_a_full_queue_is_waited_for(repository: Path) -> None:
    configure(repository / "rfm", batch_size=1)
    bound_queue(repository / "rfm", max_queue_size=1)
    samples = [ProgressSample(trajectory(seed, 32), frame_steps=16) for seed in range(16)]
    with start_triton(repository) as server:
        for url in (server.endpoints.grpc_url, server.endpoints.http_url):
            with RewardClient(url, retry=False) as client:
                outcomes = client.evaluate(samples, return_errors=True)
            with RewardClient(url, timeout_s=PATIENCE_S) as client:
                answers = client.evaluate(samples)
            refused = [outcome for outcome in outcomes if isinstance(outcome, Exception)]
            assert {type(error) for error in refused} == {ServerUnavailableError}
            assert "Exceeds maximum queue size" in str(refused[0])
            for outcome, answer in zip(outcomes, answers, strict=True):
                if not isinstance(outcome, Exception):
                    assert_same(outcome, answer)


@pytest.fixture
def nothing_shared_is_left(demo_server: Endpoints) -> Iterator[None]:
    before = ours_in_dev_shm(), regions(demo_server)
    yield
    assert ours_in_dev_shm() <= before[0]
    assert regions(demo_server) <= before[1]


@pytest.mark.usefixtures("nothing_shared_is_left")
def test_shared_memory_changes_no_answer(served: Served, demo_server: Endpoints, protocol: str) -> None:
    samples = [ProgressSample(heavy(), frame_steps=2), ProgressSample(trajectory(1))]
    mapped, named = regions(demo_server), ours_in_dev_shm()
    with RewardClient(served.url(protocol)) as client:
        expected = client.evaluate(samples)
    with RewardClient(served.url(protocol), shared_memory=True) as client:
        for _ in range(3):
            for answer, plain in zip(client.evaluate(samples), expected, strict=True):
                assert_same(answer, plain)
        client.progress(trajectory(0, 9000), frame_steps=2)  # which has no room in the region of the others
        assert len(regions(demo_server) - mapped) == 1  # one, used again and again, or replaced
        assert ours_in_dev_shm() == named  # the name is gone during use


@pytest.mark.slow
@pytest.mark.usefixtures("nothing_shared_is_left")
def test_memory_of_cancelled_calls_never_mixes_with_that_of_others(demo_server: Endpoints) -> None:
    samples = [ProgressSample(trajectory(seed, 4200), frame_steps=2) for seed in range(4)]  # 1.1 MB: copied in a thread
    with RewardClient(demo_server.grpc_url) as client:
        expected = [client.evaluate([sample])[0] for sample in samples]
    with RewardClient(demo_server.grpc_url, shared_memory=True) as client:
        for late_ms in (1, 5):
            late = [client.submit(sample, timeout_s=0.001 * late_ms) for sample in samples]
            futures = [client.submit(sample) for sample in samples]
            for future, plain in zip(futures, expected, strict=True):
                assert_same(future.result(), plain)
            assert {type(future.exception()) for future in late} <= {DeadlineExceededError, type(None)}


@pytest.mark.usefixtures("nothing_shared_is_left")
def test_memory_of_a_call_at_work_is_given_back_when_the_client_closes(served: Served) -> None:
    """Triton refuses to unmap it while the request uses it, and does not do so later by itself."""
    with RewardClient(served.url("grpc"), model=MODEL, shared_memory=True) as client:
        scored = [client.submit(sample) for sample in plug()[:4]]
        wait_until_at_work(MODEL)
        for future in scored:
            future.cancel()


@pytest.mark.slow
def test_closing_a_client_of_a_hanging_server_frees_its_shared_memory(demo_server: Endpoints) -> None:
    before = ours_in_dev_shm()
    with Proxy(demo_server.grpc_port) as proxy:
        client = RewardClient(f"grpc://127.0.0.1:{proxy.port}", shared_memory=True)
        client.progress(heavy(), frame_steps=2)
        with proxy.held():
            client.close()
            assert ours_in_dev_shm() == before


LARGE = np.zeros(MIN_SHARED_BYTES, np.uint8)


class RestartedServer:
    """Stands for tritonclient's client. mapped: names of the server's regions"""

    def __init__(self) -> None:
        self.mapped: set[str] = set()

    async def register_system_shared_memory(self, name: str, *_: object) -> None:
        self.mapped.add(name)

    async def unregister_system_shared_memory(self, name: str) -> None:
        self.mapped.discard(name)


@pytest.mark.usefixtures("nothing_shared_is_left")
def test_a_restarted_server_gets_the_inputs_in_the_same_call(
    demo_server: Endpoints, monkeypatch: pytest.MonkeyPatch
) -> None:
    sample = ProgressSample(heavy(), frame_steps=2)
    with RewardClient(demo_server.grpc_url, shared_memory=True, retry=False) as client:
        before, expected = regions(demo_server), client.evaluate([sample])
        (mapped,) = regions(demo_server) - before
        with tritonclient.grpc.InferenceServerClient(demo_server.grpc_url.removeprefix("grpc://")) as triton:
            triton.unregister_system_shared_memory(mapped)  # as a restart does
        monkeypatch.setattr(limits, "MAX_REQUEST_BYTES", MIN_SHARED_BYTES)  # no room for it outside shared memory
        for _ in range(2):
            assert_same(client.evaluate([sample])[0], expected[0])
        assert mapped not in regions(demo_server)
        assert len(regions(demo_server) - before) == 1


def test_a_restart_after_a_request_that_failed_keeps_sharing_and_unmaps_what_is_lost(
    caplog: pytest.LogCaptureFixture,
) -> None:
    server, memory = RestartedServer(), SharedMemory("grpc://127.0.0.1:1")

    async def ask() -> None:
        for reason in ("an invalid sample", LOST_REGION):
            with pytest.raises(InferenceServerException, match=reason):
                async with memory.lend(server, LARGE):
                    raise InferenceServerException(reason)
        async with memory.lend(server, LARGE) as region:
            assert region is not None
            assert server.mapped == {region.name}
        await memory.close(server)

    asyncio.run(ask())
    assert not caplog.records


def test_a_full_dev_shm_is_tried_again(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    server, memory = RestartedServer(), SharedMemory("grpc://127.0.0.1:1")
    full = SimpleNamespace(f_bavail=0, f_frsize=1, f_blocks=1)

    async def ask() -> None:
        with monkeypatch.context() as patched:
            patched.setattr(os, "statvfs", lambda _: full)
            for _ in range(2):
                async with memory.lend(server, LARGE) as region:
                    assert region is None
        async with memory.lend(server, LARGE) as region:
            assert region is not None
        await memory.close(server)

    asyncio.run(ask())
    (told,) = (record.message for record in caplog.records)
    assert told.endswith("less than half of /dev/shm would stay free")


def test_a_region_is_made_beside_the_event_loop_and_a_cancelled_one_leaves_no_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begun, may_end, before = threading.Event(), threading.Event(), ours_in_dev_shm()
    reserve = os.posix_fallocate

    def slow(*arguments: int) -> None:
        begun.set()
        assert may_end.wait(PATIENCE_S)
        reserve(*arguments)

    monkeypatch.setattr(os, "posix_fallocate", slow)
    memory = SharedMemory("grpc://127.0.0.1:1")

    async def lend() -> None:
        async with memory.lend(RestartedServer(), LARGE):
            raise AssertionError("expected no region")

    async def ask() -> None:
        lending = asyncio.create_task(lend())
        await asyncio.to_thread(begun.wait, PATIENCE_S)
        lending.cancel()
        with pytest.raises(asyncio.CancelledError):
            await lending
        may_end.set()

    asyncio.run(ask())
    assert ours_in_dev_shm() == before


def test_behind_a_load_balancer_no_region_is_shared_after_the_first(caplog: pytest.LogCaptureFixture) -> None:
    mapping, memory = RestartedServer(), SharedMemory("grpc://127.0.0.1:1")

    async def ask() -> None:
        with pytest.raises(InferenceServerException):
            async with memory.lend(mapping, LARGE):
                raise InferenceServerException(LOST_REGION)  # from another server
        async with memory.lend(mapping, LARGE) as region:
            assert region is None
        await memory.close(mapping)

    asyncio.run(ask())
    assert not mapping.mapped
    assert [record.message for record in caplog.records] == [
        "grpc://127.0.0.1:1: no shared memory, inputs go through the socket: several servers share this address: one "
        "has mapped a region, another was asked"
    ]


@pytest.mark.usefixtures("nothing_shared_is_left")
def test_a_server_with_another_dev_shm_gets_the_inputs_through_the_socket(
    served: Served, protocol: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As in a container whose port is mapped to this host."""
    samples = [ProgressSample(heavy(), frame_steps=2)] * 2
    with RewardClient(served.url(protocol)) as client:
        expected = client.evaluate(samples)
    with (
        TemporaryDirectory(dir=shared_memory.FOLDER) as folder,
        RewardClient(served.url(protocol), shared_memory=True, retry=False) as client,
    ):
        monkeypatch.setattr(shared_memory, "FOLDER", Path(folder))
        for _ in range(2):
            for answer, plain in zip(client.evaluate(samples), expected, strict=True):
                assert_same(answer, plain)
        assert not [*Path(folder).iterdir()]
    (told,) = (record.message for record in caplog.records if record.name == "rfm_client")
    assert "no shared memory, inputs go through the socket: Unable to open shared memory region" in told


ASKING = """
import os, resource, signal, sys
import numpy as np
from rfm_client import RewardClient, Trajectory
{before}
with RewardClient(sys.argv[1], shared_memory=True) as client:
    trajectory = Trajectory(video_embeddings=np.ones((2000, 64)), text_embedding=np.ones(32))
    print(client.progress(trajectory, frame_steps=2).last_progress)
    {after}
"""
FULL = "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, 2**16))"


def ask_elsewhere(url: str, before: str = "", after: str = "") -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", ASKING.format(before=before, after=after), url]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


def test_a_killed_client_leaves_no_data(demo_server: Endpoints) -> None:
    before = ours_in_dev_shm()
    killed = ask_elsewhere(demo_server.grpc_url, after="os.kill(os.getpid(), signal.SIGKILL)")
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert ours_in_dev_shm() == before


def test_with_a_full_dev_shm_the_client_logs_it_and_sends_inputs_through_the_socket(demo_server: Endpoints) -> None:
    done = ask_elsewhere(demo_server.grpc_url, before=FULL)  # as a full /dev/shm, for this process alone
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) > 0
    assert "no shared memory, inputs go through the socket: [Errno 27] File too large" in done.stderr
