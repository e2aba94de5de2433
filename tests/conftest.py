# SPDX-License-Identifier: MIT
from __future__ import annotations

import os
import shutil
import signal
import uuid
from collections.abc import Callable, Iterator

import pytest
import torch
from _pytest.runner import runtestprotocol

import goldens
import rfm_export
from commands import RUN
from engines import load_engine, serve_config
from environments import MODEL, LateClient
from paths import ROOT
from rfm.engine import Engine
from rfm.serve import access
from rfm_client import RewardClient
from servers import CRASHES, Endpoints, Served, start_triton

pytest_plugins = ("debian", "gateway_fixtures")
SHARED = ("served", "triton")  # fixtures that start a server for the tests of many files
LONGEST = {"supervise", "triton"}  # folders whose tests wait longest: the others run meanwhile

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it for what runs in its background
torch.set_num_threads(1)
os.environ["OMP_NUM_THREADS"] = "1"  # of processes that tests start, since other tests need the cores
os.environ[RUN] = uuid.uuid4().hex  # marks the processes of this run
os.environ["HF_HUB_OFFLINE"] = "1"  # no test asks the network
os.environ["HF_HUB_DISABLE_PROGRESS_BARS"] = "1"  # transformers 5 shows one per load, on standard error
worker, workers = os.getenv("PYTEST_XDIST_WORKER", "gw0"), os.getenv("PYTEST_XDIST_WORKER_COUNT", "1")
access.PORTS = access.PORTS[int(worker.removeprefix("gw")) :: int(workers)]  # no two workers choose the same port
os.environ["ONEDNN_MAX_CPU_ISA"] = "AVX512_CORE"  # as the references were computed: AMX rounds bfloat16 elsewhere


@pytest.fixture
def engine() -> Callable[[str], Engine]:
    return load_engine


@pytest.fixture(scope="session")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """The shared server: two reference checkpoints, and the demo's as ``rfm``. A test may have it serve others, too."""
    repository = shutil.copytree(ROOT / "model_repository", tmp_path_factory.mktemp("served") / "model_repository")
    for config in goldens.SERVED:
        rfm_export.export(config.checkpoint, repository, serve_config(config, config.name))
    with start_triton(repository) as server:
        yield Served(server)


@pytest.fixture(scope="session")
def demo_server(served: Served) -> Endpoints:
    """Where the demo's checkpoint is asked under the name that clients expect."""
    return served.endpoints


@pytest.fixture
def client(served: Served) -> Iterator[RewardClient]:
    with served.client("grpc", MODEL) as client:
        yield client


@pytest.fixture
def late(served: Served) -> Iterator[LateClient]:
    with LateClient(served.url("grpc")) as client:
        yield client


@pytest.fixture(autouse=True)
def _served_lives(request: pytest.FixtureRequest) -> None:
    if "served" in request.fixturenames:
        request.getfixturevalue("served").revive()


@pytest.fixture(autouse=True)
def _priority_stays() -> Iterator[None]:
    """A test that left this process a real-time priority would keep all later servers from the processors."""
    yield
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


@pytest.fixture(params=["grpc", "http"])
def protocol(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool:
    """Run a failed test again if Triton 2.51 aborted or hung at the start, which happens now and then."""
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    CRASHES.clear()
    reports = runtestprotocol(item, nextitem=nextitem, log=False)
    if CRASHES and any(report.failed for report in reports):
        item._initrequest()  # type: ignore[attr-defined]  # as pytest-rerunfailures does
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests with a shared server ``triton``, and keep them in one of the test processes.

    Tests with another server than ``served`` are ``slow``. The tests of a file stay together, since they share servers.
    """
    for item in items:
        shared = next((name for name in SHARED if name in getattr(item, "fixturenames", ())), None)
        if shared:
            item.add_marker("triton")
        if shared != "served" and item.get_closest_marker("triton"):
            item.add_marker("slow")  # a server of its own, or the gateway's
        item.add_marker(pytest.mark.xdist_group(shared or str(item.path)))
    items.sort(key=lambda item: item.path.parent.name not in LONGEST)
