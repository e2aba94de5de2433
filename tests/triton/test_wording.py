# SPDX-License-Identifier: MIT
"""Each phrase that rfm_client.contract.triton recognises, from a real Triton."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any

import numpy as np
import pytest
import tritonclient.grpc
import tritonclient.http
from tritonclient.utils import InferenceServerException, np_to_triton_dtype

import goldens
import rfm_export
from engines import serve_config
from mixtures import FRAMES_MODEL, MODEL
from repositories import kill_model
from rfm_client import (
    InvalidSampleError,
    ModelNotFoundError,
    ProcessEndedError,
    ProgressSample,
    RewardError,
    ServerUnavailableError,
)
from rfm_client.contract import triton, wire
from servers import Served
from trajectories import random_trajectory

pytestmark = pytest.mark.triton


class Asker:
    """Asks in tensors, by tritonclient itself."""

    def __init__(self, served: Served, protocol: str) -> None:
        self.module = tritonclient.grpc if protocol == "grpc" else tritonclient.http
        self.client = self.module.InferenceServerClient(served.url(protocol).partition("://")[2])

    def infer(self, model: str, tensors: wire.Tensors, region: str | None = None, output: str = wire.PROGRESS) -> Any:
        inputs = []
        for name, array in tensors.items():
            inputs.append(self.module.InferInput(name, array.shape, np_to_triton_dtype(array.dtype)))
            if name == wire.VIDEO_EMBEDDINGS and region is not None:
                inputs[-1].set_shared_memory(region, array.nbytes)
            else:
                inputs[-1].set_data_from_numpy(array)
        outputs = [self.module.InferRequestedOutput(output)]
        return self.client.infer(model, inputs, outputs=outputs, request_id="a-request")


@pytest.fixture
def asker(served: Served, protocol: str) -> Iterator[Asker]:
    made = Asker(served, protocol)
    with made.client:
        yield made


def embedded(width: int = 768) -> wire.Tensors:
    return wire.encode_samples([ProgressSample(random_trajectory(0, 2, width))])


NO_FRAMES: wire.Tensors = {
    wire.SAMPLE_TYPE: np.zeros((1, 1), np.uint8),
    wire.NUM_FRAMES: np.zeros((1, 2), np.int32),
    wire.FRAME_STEPS: np.zeros((1, 1), np.int32),
    wire.FRAMES: np.zeros((1, 1, 8, 8, 3), np.uint8),
    wire.TASK: np.array([[b"lift"]], np.object_),
}
PHRASES: dict[str, tuple[Callable[[Asker], Any], str, type[RewardError], str]] = {
    "an unknown model": (lambda a: a.infer("nowhere", embedded()), "unknown model", ModelNotFoundError, "nowhere"),
    "a lost region": (lambda a: a.infer(MODEL, embedded(), "gone"), triton.LOST_REGION, ServerUnavailableError, "gone"),
    "another width": (
        lambda a: a.infer(MODEL, embedded(65)),
        "unexpected shape for input",
        InvalidSampleError,
        r"^video_embeddings: expected \[-1,768\], got \[2,65\]$",
    ),
    "an unknown output": (
        lambda a: a.infer(MODEL, embedded(), output="unclear"),
        "unexpected inference output",
        InvalidSampleError,
        "^unclear: ",
    ),
    "an ensemble": (
        lambda a: a.infer(f"{FRAMES_MODEL}_frames", NO_FRAMES),
        f"in ensemble '{FRAMES_MODEL}_frames', ",
        InvalidSampleError,
        "^num_frames: expected ",
    ),
}


def failure(ask: Callable[[], Any]) -> tuple[str, str]:
    """Return status and message of a refusal by Triton."""
    with pytest.raises(InferenceServerException) as caught:
        ask()
    return str(caught.value.status()), caught.value.message()


@pytest.mark.parametrize("name", PHRASES)
def test_triton_says_so_in_these_words(asker: Asker, name: str) -> None:
    ask, phrase, kind, meant = PHRASES[name]
    status, message = failure(lambda: ask(asker))
    assert phrase in message
    error = triton.error_of(
        status, message, ModelNotFoundError if kind is ModelNotFoundError else triton.invalid_sample
    )
    assert type(error) is kind
    assert "a-request" not in error.message
    with pytest.raises(kind, match=meant):
        raise error


@pytest.mark.nightly
@pytest.mark.slow
def test_a_dead_process_and_an_unloaded_model_give_different_errors(served: Served) -> None:
    config, model = goldens.config(MODEL), "mortal"
    rfm_export.export(config.checkpoint, served.repository, serve_config(config, model))
    askers = [Asker(served, protocol) for protocol in ("grpc", "http")]

    def answers() -> None:
        for asker in askers:
            asker.infer(model, embedded())

    def says(phrase: str, kind: type[RewardError]) -> None:
        for asker in askers:
            status, message = failure(partial(asker.infer, model, embedded()))
            assert phrase in message
            assert type(triton.error_of(status, message, triton.invalid_sample)) is kind

    with ExitStack() as clients, served.api() as api:
        for asker in askers:
            clients.enter_context(asker.client)
        api.load(model)
        answers()
        api.unload(model)
        api.wait_gone(model)
        says(triton.NO_VERSIONS, ServerUnavailableError)
        api.load(model)
        answers()
        kill_model(served.repository, model)
        says(triton.PROCESS_ENDED, ProcessEndedError)
        api.unload(model)
