# SPDX-License-Identifier: MIT
"""The checkpoint is replaced, late or missing while the gateway asks. A stand-in for Triton does it when a test wants."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from gateway_requests import FIRST, Json, answered, ask_json, failure, filmed, progress
from gateways import StandIn, TestClient, inside
from rfm_client import ModelInfo
from servers import wait_for
from shelves import V2

SAMPLE = progress(filmed(1, 4, size_px=8))


class Rollout(StandIn):
    """A server in whose second version two frames share a value."""

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        info = await super().model_info(model, timeout_s)
        return replace(info, frames_per_value=1 + (info.versions == (V2.version,)))


class Baseline(Rollout):
    """A server of RoboReward that takes one sample a request. The gateway shows it each prefix of an episode."""

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        return replace(await super().model_info(model, timeout_s), scores_whole_prefixes=True, max_batch_size=1)


@contextmanager
def replaced_after_one_request(kind: type[StandIn]) -> Iterator[TestClient]:
    triton = kind(after=1)
    triton.is_open.set()
    with inside(triton=triton, metrics_url="http://127.0.0.1:1/metrics") as client:
        yield client


def test_values_are_those_of_the_version_that_answers() -> None:
    with replaced_after_one_request(Rollout) as client:
        first, second = (answered(ask_json(client, [SAMPLE]))["outputs_progress"] for _ in range(2))
        np.testing.assert_allclose(first["progress_pred"], [[0.1] * 4], rtol=1e-6)
        np.testing.assert_allclose(second["progress_pred"], [[0.9] * 2], rtol=1e-6)
        assert client.get("/model_info").json()["model_version"] == V2.version


def test_prefixes_that_several_versions_scored_are_no_curve() -> None:
    with replaced_after_one_request(Baseline) as client:
        message = failure(ask_json(client, [SAMPLE], use_frame_steps=True), 502)
        assert message.startswith("model_version: expected one for all frames, got ")
        (values,) = answered(ask_json(client, [SAMPLE], use_frame_steps=True))["outputs_progress"]["progress_pred"]
        assert len(values) == 4


def test_a_model_that_answers_no_probe_in_time_may_be_busy_and_is_healthy() -> None:
    with inside(triton=StandIn(served=["rfm"]), metrics_url="http://127.0.0.1:1/metrics") as client:
        assert client.get("/health").json()["status"] == "healthy"


LOST = {"rfm": FIRST, "rfm_encoder": {**FIRST, "text_embedding": None}, "rfm_frames": SAMPLE["trajectory"]}


@pytest.mark.parametrize(("model", "trajectory"), LOST.items(), ids=LOST)
def test_a_model_that_is_missing_after_a_restart_is_no_fault_of_the_caller(model: str, trajectory: Json) -> None:
    """A Triton may load one model after another."""
    triton = StandIn()
    triton.is_open.set()
    with inside(triton=triton, metrics_url="http://127.0.0.1:1/metrics") as client:
        assert client.get("/health").status_code == 200
        answered(ask_json(client, [progress(trajectory)]))
        triton.served = {"rfm", "rfm_encoder", "rfm_frames"} - {model}
        for response in (client.get("/model_info"), ask_json(client, [progress(trajectory)])):
            assert re.fullmatch(
                rf"{model}: it answered before: .*: try again( \(request .*\))?", failure(response, 503)
            )
            assert response.headers["Retry-After"] == "1"
        wait_for(lambda: client.get("/health").status_code == 503)  # the earlier state is reported for another second
        assert failure(client.get("/health"), 503).startswith(f"{model}: it answered before")
