# SPDX-License-Identifier: MIT
"""Each phrase by which rfm_client.contract.triton knows what happened, from a real Triton."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tritonclient.grpc
import tritonclient.http
from tritonclient.utils import InferenceServerException, np_to_triton_dtype

from commands import REPOSITORY
from faulty_servers import url_of
from one_model import BriefServer, OneModelServer
from patients import answering_after, make_repository
from repositories import bound_queue, kill_model
from rfm.launch.installation import find_installation
from rfm.launch.process import Endpoints
from rfm.launch.repository_api import RepositoryApi
from rfm_client import (
    InvalidSampleError,
    ModelNotFoundError,
    ProcessEndedError,
    ProgressSample,
    RewardClient,
    RewardError,
    ServerUnavailableError,
)
from rfm_client.contract import triton, wire
from rfm_serve import wait_for
from trajectories import random_trajectory

pytestmark = pytest.mark.triton

KEY = "the-key-of-this-test"
DIMS = (64, 32)  # of the demo's checkpoint


class Triton:
    """The demo's checkpoint, asked in tensors by tritonclient itself."""

    def __init__(self, repository: Path, endpoints: Endpoints, protocol: str) -> None:
        self.repository = repository
        self.module = tritonclient.grpc if protocol == "grpc" else tritonclient.http
        port = endpoints.grpc_port if protocol == "grpc" else endpoints.http_port
        self.client = self.module.InferenceServerClient(f"{endpoints.host}:{port}")

    def infer(self, model: str = "rfm", width: int = DIMS[0], region: str | None = None, version: str = "") -> Any:
        tensors = wire.encode_samples([ProgressSample(random_trajectory(0, 2, width, DIMS[1]))])
        inputs = []
        for name, array in tensors.items():
            tensor = self.module.InferInput(name, array.shape, np_to_triton_dtype(array.dtype))
            if name == wire.VIDEO_EMBEDDINGS and region is not None:
                tensor.set_shared_memory(region, array.nbytes)
            else:
                tensor.set_data_from_numpy(array)
            inputs.append(tensor)
        return self.client.infer(model, inputs, model_version=version, request_id="a-request")


@pytest.fixture(scope="module")
def endpoints_and_repository(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Endpoints, Path]]:
    folder = tmp_path_factory.mktemp("wording")
    repository = folder / "model_repository"
    shutil.copytree(REPOSITORY, repository, ignore=shutil.ignore_patterns("__pycache__"))
    with (
        (folder / "tritonserver.log").open("wb") as log,
        BriefServer(repository, Endpoints.free(), find_installation(), log=log, admin_key=KEY) as server,
    ):
        yield server.endpoints, repository


@pytest.fixture
def asked(endpoints_and_repository: tuple[Endpoints, Path], protocol: str) -> Iterator[Triton]:
    endpoints, repository = endpoints_and_repository
    triton_of_this = Triton(repository, endpoints, protocol)
    with triton_of_this.client:
        yield triton_of_this


PHRASES: dict[str, tuple[Callable[[Triton], Any], str, type[RewardError], str]] = {
    "an unknown model": (lambda t: t.infer("nowhere"), "unknown model", ModelNotFoundError, "nowhere"),
    "a lost region": (lambda t: t.infer(region="gone"), triton.LOST_REGION, ServerUnavailableError, "gone"),
    "another width": (
        lambda t: t.infer(width=65),
        "unexpected shape for input",
        InvalidSampleError,
        r"^video_embeddings: expected \[-1,64\], got \[2,65\]$",
    ),
    "an ensemble": (
        lambda t: t.client.infer("rfm_frames", _frames(t, num_frames=0)),
        "in ensemble 'rfm_frames', ",
        InvalidSampleError,
        "^num_frames: expected ",
    ),
}


def _frames(asked: Triton, num_frames: int) -> list[Any]:
    tensors = {
        wire.SAMPLE_TYPE: np.zeros((1, 1), np.uint8),
        wire.NUM_FRAMES: np.array([[num_frames, 0]], np.int32),
        wire.FRAME_STEPS: np.zeros((1, 1), np.int32),
        wire.FRAMES: np.zeros((1, 1, 8, 8, 3), np.uint8),
        wire.TASK: np.array([[b"lift"]], np.object_),
    }
    inputs = []
    for name, array in tensors.items():
        inputs.append(asked.module.InferInput(name, array.shape, np_to_triton_dtype(array.dtype)))
        inputs[-1].set_data_from_numpy(array)
    return inputs


def failure(ask: Callable[[], Any]) -> tuple[str, str]:
    """Status and message of what Triton refuses."""
    with pytest.raises(InferenceServerException) as caught:
        ask()
    return str(caught.value.status()), caught.value.message()


@pytest.mark.parametrize("name", PHRASES)
def test_triton_says_so_in_these_words(asked: Triton, name: str) -> None:
    ask, phrase, kind, meant = PHRASES[name]
    status, message = failure(lambda: ask(asked))
    assert phrase in message
    error = triton.error_of(status, message, ModelNotFoundError if kind is ModelNotFoundError else InvalidSampleError)
    assert type(error) is kind
    with pytest.raises(kind, match=meant):
        raise error


SLOW = answering_after(0.3)


@pytest.mark.slow
@pytest.mark.parametrize("instances", [1, 2])
def test_a_full_queue_says_so_in_these_words(tmp_path: Path, protocol: str, instances: int) -> None:
    repository = make_repository(tmp_path, more_code=SLOW, instances=instances, batch_size=1)
    bound_queue(repository / "rfm", max_queue_size=1)
    with (
        (tmp_path / "tritonserver.log").open("wb") as log,
        BriefServer(repository, Endpoints.free(), find_installation(), log=log) as server,
        ThreadPoolExecutor(12) as callers,
    ):

        def ask() -> tuple[str, str] | None:
            asked = Triton(repository, server.endpoints, protocol)
            with asked.client:
                try:
                    asked.infer()
                except InferenceServerException as error:
                    return str(error.status()), error.message()
            return None

        told = {outcome for outcome in callers.map(lambda _: ask(), range(12)) if outcome is not None}
    assert told
    for status, message in told:
        assert "Exceeds maximum queue size" in message
        assert status in triton.UNAVAILABLE
        assert type(triton.error_of(status, message, InvalidSampleError)) is ServerUnavailableError


@pytest.mark.slow
def test_a_connection_that_ends_under_a_request_is_told_from_one_that_is_refused(tmp_path: Path, protocol: str) -> None:
    began = tmp_path / "began"
    repository = make_repository(tmp_path, more_code=answering_after(0.3, began))
    with (
        OneModelServer(repository, Endpoints.free()) as server,
        RewardClient(url_of(server.endpoints, protocol), retry=False) as client,
    ):
        sample = ProgressSample(random_trajectory(0, 2, *DIMS))
        client.evaluate([sample])
        began.unlink()
        future = client.submit(sample)
        wait_for(began.exists)
        server.kill()
        under_way = future.exception()
        (refused,) = client.evaluate([sample], return_errors=True)
    for error in (under_way, refused):
        assert type(error) is ServerUnavailableError
    assert [error.may_have_ended_server for error in (under_way, refused)] == [True, False], (under_way, refused)


def test_a_request_id_is_no_part_of_the_error(asked: Triton) -> None:
    status, message = failure(lambda: asked.infer(width=65))
    assert "a-request" not in triton.error_of(status, message, InvalidSampleError).message


def test_a_restricted_api_wants_its_key(asked: Triton) -> None:
    status, message = failure(asked.client.get_model_repository_index)
    assert triton.RESTRICTED in message
    assert triton.is_denied(status, message)


@pytest.mark.slow
def test_a_dead_process_and_an_unloaded_model_are_told_apart(tmp_path: Path, protocol: str) -> None:
    repository = tmp_path / "model_repository"
    shutil.copytree(REPOSITORY / "rfm", repository / "rfm", ignore=shutil.ignore_patterns("__pycache__"))
    with (
        (tmp_path / "tritonserver.log").open("wb") as log,
        BriefServer(repository, Endpoints.free(), find_installation(), log=log, admin_key=KEY) as server,
        RepositoryApi(server.endpoints.grpc_url, KEY) as api,
    ):
        asked = Triton(repository, server.endpoints, protocol)
        with asked.client:
            asked.infer()
            api.unload("rfm")
            api.wait_gone("rfm")
            status, message = failure(asked.infer)
            assert triton.NO_VERSIONS in message
            assert type(triton.error_of(status, message, InvalidSampleError)) is ServerUnavailableError
            api.load("rfm")
            asked.infer()
            kill_model(repository)
            status, message = failure(asked.infer)
            assert triton.PROCESS_ENDED in message
            assert type(triton.error_of(status, message, InvalidSampleError)) is ProcessEndedError
