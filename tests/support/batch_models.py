# SPDX-License-Identifier: MIT
"""A model with plain scores, and stand-ins for Triton's requests."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

from rfm.engine import Execution
from rfm.triton_model.batch_model import BatchModel
from rfm_client import (
    InferenceFailedError,
    InvalidSampleError,
    ProgressResult,
    ProgressSample,
    Result,
    RewardError,
    Sample,
)
from rfm_client.contract import wire
from rfm_client.contract.description import DESCRIPTION_PARAMETER, Description
from rfm_client.contract.process import LEVEL_VARIABLE, LogLines
from servers import wait_for
from trajectories import random_trajectory

WIDTHS = (4, 3)
CONFIG = {
    "input": [
        {"name": "sample_type", "dims": [1]},
        {"name": "num_frames", "dims": [2]},
        {"name": "frame_steps", "dims": [1]},
        {"name": "video_embeddings", "dims": [-1, WIDTHS[0]]},
        {"name": "text_embedding", "dims": [WIDTHS[1]]},
    ],
    "max_batch_size": 8,
    "instance_group": [{"count": 1}],
}
BARE = Description()
FINAL = 1  # Triton's flag of the last response to a request
REFUSED, BREAKS, FAILS = 2, 3, 4  # numbers of frames on which the model fails


@dataclass
class Tensor:
    """An input, as Triton hands it over."""

    its_name: str
    array: npt.NDArray[Any]

    def name(self) -> str:
        return self.its_name

    def as_numpy(self) -> npt.NDArray[Any]:
        return self.array


@dataclass
class Request:
    """A request as Triton hands it over, with the responses."""

    tensors: wire.Tensors
    id: str = ""
    is_given_up: bool = False
    responses: list[Response] = field(default_factory=list)

    def request_id(self) -> str:
        return self.id

    def inputs(self) -> list[Tensor]:
        return [Tensor(name, array) for name, array in self.tensors.items()]

    def requested_output_names(self) -> list[str]:
        return ["progress"]

    def get_response_sender(self) -> Request:
        return self

    def is_cancelled(self) -> bool:
        return self.is_given_up

    def send(self, response: Response, flags: int) -> None:
        assert flags == FINAL
        self.responses.append(response)


@dataclass
class Response:
    output_tensors: Sequence[Any] = ()
    error: Any = None


MODELS: list[Model] = []  # of the test that runs


class Model(BatchModel[Sample, Result]):
    """Scores each frame with how many there are."""

    def __init__(
        self,
        folder: Path,
        warmups: int = 0,
        settings: Mapping[str, str] = MappingProxyType({}),
        description: Description = BARE,
    ) -> None:
        MODELS.append(self)
        self.batches: list[int] = []
        settings = {"torch_threads": "1", DESCRIPTION_PARAMETER: description.to_json(), **settings}
        parameters = {name: {"string_value": value} for name, value in settings.items()}
        config = CONFIG | {"parameters": parameters, "model_warmup": [{"count": 0}] * warmups}
        instance = {"model_instance_name": "rfm_0_0", "model_instance_kind": "CPU", "model_instance_device_id": "0"}
        model = {"model_repository": str(folder), "model_version": "1", "model_name": "rfm"}
        self.initialize({"model_config": json.dumps(config), **model, **instance})

    def load(self, version: Path, device: torch.device, settings: Mapping[str, str]) -> None:
        pass

    def respond(self, *requests: Request) -> list[Response]:
        """Hand requests over at once. Return the responses."""
        self.take(*requests)
        wait_for(lambda: all(request.responses for request in requests))
        return [response for request in requests for response in request.responses]

    def take(self, *requests: Request) -> None:
        """Hands the requests over, as Triton does, and keeps the responses that come at once."""
        for request, response in zip(requests, self.execute(requests) or (), strict=False):
            request.responses.append(response)

    def decode(self, tensors: wire.Tensors) -> list[Sample]:
        return wire.decode_samples(tensors)

    def answer(self, questions: Sequence[Sample], execution: Execution) -> list[Result | RewardError]:
        self.batches.append(len(questions))
        counts = [question.trajectories[0].num_frames for question in questions]
        if BREAKS in counts:
            raise RuntimeError("made up")
        errors = {
            REFUSED: InvalidSampleError.at("num_frames", "others", "these"),
            FAILS: InferenceFailedError("failed"),
        }
        scores = [np.full(count, count, np.float32) for count in counts]
        return [
            errors.get(count) or ProgressResult(progress=score, success=score)
            for count, score in zip(counts, scores, strict=True)
        ]

    def encode(self, answers: Sequence[Result], tensors: wire.Tensors, outputs: Collection[str]) -> wire.Tensors:
        return wire.encode_results(answers, wire.num_positions(tensors), outputs)

    def told(self, name: str) -> dict[tuple[str, ...], float]:
        """Return a metric's values by the labels that do not name the instance."""
        self.finalize()
        own = {"model", "version", "device", "instance"}
        return {
            tuple(value for label, value in metric.labels.items() if label not in own): metric.value
            for metric in METRICS
            if metric.name == f"rfm_{name}" and metric.value
        }

    @property
    def samples(self) -> dict[tuple[str, ...], float]:
        return self.told("samples_total")


@dataclass
class Metric:
    """Triton's: a counter, a gauge, or the sum of a histogram."""

    name: str
    labels: dict[str, str]
    value: float = 0.0

    def increment(self, by: float) -> None:
        self.value += by

    observe = increment

    def set(self, value: float) -> None:
        self.value = value


class MetricFamily:
    COUNTER, GAUGE, HISTOGRAM = range(3)

    def __init__(self, name: str, description: str, kind: int) -> None:
        self.name = name

    def Metric(self, labels: dict[str, str], buckets: Sequence[float] = ()) -> Metric:  # noqa: N802  Triton's word
        METRICS.append(Metric(self.name, dict(labels)))
        return METRICS[-1]


METRICS: list[Metric] = []
LOGGED: list[str] = []  # lines


@pytest.fixture(autouse=True)
def backend(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    def error_of(message: str, code: str) -> tuple[str, str]:
        return code, message

    codes = {"INVALID_ARG": "invalid", "INTERNAL": "internal", "CANCELLED": "cancelled"}
    for name, code in codes.items():
        setattr(error_of, name, code)

    class Log(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            LOGGED.extend(LogLines("rfm/1").format(record).splitlines())

    module = SimpleNamespace(
        InferenceResponse=Response,
        TritonError=error_of,
        Tensor=lambda name, array: (name, array.tolist()),
        TRITONSERVER_RESPONSE_COMPLETE_FINAL=FINAL,
        MetricFamily=MetricFamily,
    )
    monkeypatch.setitem(sys.modules, "triton_python_backend_utils", module)  # type: ignore[arg-type]
    monkeypatch.setenv(LEVEL_VARIABLE, "DEBUG")
    log, handler = logging.getLogger("rfm"), Log()
    log.addHandler(handler)
    yield
    log.removeHandler(handler)
    while MODELS:
        MODELS.pop().finalize()
    METRICS.clear()
    LOGGED.clear()


def request(*num_frames: int, **more: Any) -> Request:
    samples = [ProgressSample(random_trajectory(count, count, *WIDTHS)) for count in num_frames]
    return Request(wire.encode_samples(samples), **more)
