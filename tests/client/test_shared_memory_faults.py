# SPDX-License-Identifier: MIT
"""Shared memory while calls are cancelled, servers restart and clients are killed."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from faulty_servers import heavy, ours_in_dev_shm, regions, trajectory, url_of
from mixtures import assert_same, wait_until_at_work
from one_model import OneModelServer
from patients import answering_after, make_repository
from rfm.launch.process import Endpoints
from rfm_client import (
    DeadlineExceededError,
    ProgressSample,
    RewardClient,
)
from rfm_serve import MODEL

pytestmark = [pytest.mark.triton, pytest.mark.slow]


def test_shared_memory_changes_no_answer_and_leaves_nothing(repository: Path, protocol: str) -> None:
    endpoints = Endpoints.free()
    samples = [ProgressSample(heavy(), frame_steps=2), ProgressSample(trajectory(1))]
    before = ours_in_dev_shm()
    with OneModelServer(repository, endpoints):
        with RewardClient(url_of(endpoints, protocol)) as client:
            expected = client.evaluate(samples)
        with RewardClient(url_of(endpoints, protocol), shared_memory=True) as client:
            assert regions(endpoints) == set()
            for _ in range(3):
                for answer, plain in zip(client.evaluate(samples), expected, strict=True):
                    assert_same(answer, plain)
            assert len(regions(endpoints)) == 1  # one, used again and again
            assert ours_in_dev_shm() == before  # its name is gone while it is in use
        assert regions(endpoints) == set()
    assert ours_in_dev_shm() == before


def test_memory_of_cancelled_calls_never_mixes_with_that_of_others(repository: Path) -> None:
    endpoints = Endpoints.free()
    samples = [ProgressSample(trajectory(seed, 4200), frame_steps=2) for seed in range(4)]  # 1.1 MB: copied in a thread
    with OneModelServer(repository, endpoints):
        with RewardClient(endpoints.grpc_url) as client:
            expected = [client.evaluate([sample])[0] for sample in samples]
        with RewardClient(endpoints.grpc_url, shared_memory=True) as client:
            for round_number in range(10):
                late = [client.submit(sample, timeout_s=0.001 * (1 + round_number)) for sample in samples]
                futures = [client.submit(sample) for sample in samples]
                for future, plain in zip(futures, expected, strict=True):
                    assert_same(future.result(), plain)
                assert {type(future.exception()) for future in late} <= {DeadlineExceededError, type(None)}


def test_memory_of_a_call_at_work_is_given_back_when_the_client_closes(tmp_path: Path, protocol: str) -> None:
    """Triton refuses to unmap it while the request uses it, and does not do so later by itself."""
    endpoints = Endpoints.free()
    with OneModelServer(make_repository(tmp_path, more_code=answering_after(0.7)), endpoints):
        with RewardClient(url_of(endpoints, protocol), shared_memory=True) as client:
            client.progress(heavy(), frame_steps=2)
            assert len(regions(endpoints)) == 1
            scored = client.submit(ProgressSample(heavy(), frame_steps=2))
            wait_until_at_work(MODEL)
            scored.cancel()
        assert regions(endpoints) == set()


def test_shared_memory_survives_a_restart_of_the_server(repository: Path) -> None:
    endpoints = Endpoints.free()
    with RewardClient(endpoints.grpc_url, shared_memory=True) as client:
        with OneModelServer(repository, endpoints):
            expected = client.progress(heavy(), frame_steps=2)
        with OneModelServer(repository, endpoints):
            assert_same(client.progress(heavy(), frame_steps=2), expected)
            assert len(regions(endpoints)) == 1


KILLED_CLIENT = """
import os, signal, sys
import numpy as np
from rfm_client import RewardClient, Trajectory
client = RewardClient(sys.argv[1], shared_memory=True)
client.progress(Trajectory(video_embeddings=np.ones((2000, 64)), text_embedding=np.ones(32)), frame_steps=2)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_client_leaves_no_data(repository: Path) -> None:
    endpoints = Endpoints.free()
    before = ours_in_dev_shm()
    with OneModelServer(repository, endpoints):
        killed = subprocess.run([sys.executable, "-c", KILLED_CLIENT, endpoints.grpc_url], timeout=60)
        assert killed.returncode == -signal.SIGKILL
        assert ours_in_dev_shm() == before
        with RewardClient(endpoints.grpc_url, shared_memory=True) as client:
            assert client.progress(heavy(), frame_steps=2).last_progress > 0


OUT_OF_MEMORY = """
import resource, signal, sys
import numpy as np
from rfm_client import RewardClient, Trajectory
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, 2**16))  # as a full /dev/shm, for this process alone
with RewardClient(sys.argv[1], shared_memory=True) as client:
    trajectory = Trajectory(video_embeddings=np.ones((2000, 64)), text_embedding=np.ones(32))
    print(client.progress(trajectory, frame_steps=2).last_progress)
"""


def test_a_full_dev_shm_kills_nobody(repository: Path) -> None:
    endpoints = Endpoints.free()
    with OneModelServer(repository, endpoints):
        command = [sys.executable, "-c", OUT_OF_MEMORY, endpoints.grpc_url]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) > 0
    assert "no shared memory, inputs go through the socket: [Errno 27] File too large" in done.stderr
