# SPDX-License-Identifier: MIT
"""A served checkpoint that has neither a success head nor a preference head, as every door shows it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import requests

import goldens
import rfm_export
from engines import load_engine, serve_config
from environments import MODEL, TASK, cart_pole, play
from gateways import running
from rfm_client import InvalidSampleError, PreferenceSample, ProgressResult, ProgressSample, RewardClient, Trajectory
from rfm_rl import RewardModelWrapper, RewardOptions, SuccessRule
from servers import Endpoints, start_triton
from spoilt import without

pytestmark = pytest.mark.triton


@pytest.fixture(scope="module")
def endpoints(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Endpoints]:
    folder = tmp_path_factory.mktemp("without")
    checkpoint = without(MODEL, ["preference", "success"], folder / "checkpoint")
    rfm_export.export(checkpoint, folder / "model_repository", serve_config(goldens.config(MODEL), MODEL))
    with start_triton(folder / "model_repository") as server:
        yield server.endpoints


def video(seed: int, count: int) -> Trajectory:
    frames = np.random.default_rng(seed).integers(0, 256, (count, 40, 56, 3), np.uint8)
    return Trajectory(frames=frames, task=TASK)


def test_progress_is_what_it_was_and_a_preference_fails_alone(endpoints: Endpoints, tmp_path: Path) -> None:
    good = video(0, 3)
    samples = [ProgressSample(good), PreferenceSample(video(1, 2), video(2, 3))]
    with RewardClient(endpoints.grpc_url, model=MODEL) as client:
        result, refused = client.evaluate(samples, return_errors=True)
    (expected,) = load_engine(MODEL).evaluate([ProgressSample(good)])  # with both heads
    assert isinstance(expected, ProgressResult)
    assert isinstance(refused, InvalidSampleError)
    assert "sample_type: expected progress or similarity (this checkpoint has no preference head)" in str(refused)
    assert isinstance(result, ProgressResult)
    np.testing.assert_allclose(result.progress, expected.progress, rtol=0, atol=1e-5)
    assert np.isnan(result.success).all()
    sample = {"sample_type": "progress", "trajectory": {"frames": good.positions.tolist(), "task": TASK}}
    with running(endpoints, tmp_path, MODEL) as gateway:
        answer = requests.post(f"{gateway.url}/evaluate_batch", json={"samples": [sample]}).json()
    np.testing.assert_allclose(answer["outputs_progress"]["progress_pred"][0], expected.progress, rtol=0, atol=1e-5)
    assert "outputs_success" not in answer


def test_nothing_succeeds_and_an_environment_is_not_ended_by_success(endpoints: Endpoints) -> None:
    with RewardClient(endpoints.http_url, model=MODEL) as client:
        with client.episode(TASK, success=SuccessRule(threshold=0)) as episode:
            scores = [episode.add(frame) for frame in video(3, 3).positions]
        assert all(np.isfinite(score.progress) and np.isnan(score.success) for score in scores)
        assert not any(score.succeeded for score in scores)
        env = RewardModelWrapper(cart_pole(), client, TASK, RewardOptions(terminate_on_success=SuccessRule()))
        told = r"^terminate_on_success: expected None with a checkpoint that does not predict"
        with pytest.raises(ValueError, match=told):
            env.reset(seed=0)
        rewards, infos = play(RewardModelWrapper(cart_pole(), client, TASK, RewardOptions()))
    assert np.isfinite(rewards).all()
    assert all(np.isnan(info["reward_model"]["success"]) for info in infos)
