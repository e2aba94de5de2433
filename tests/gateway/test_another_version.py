# SPDX-License-Identifier: MIT
"""The checkpoint is replaced while the gateway asks. A stand-in replaces it when a test wants."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from gateway_requests import filmed, progress
from rfm_client import AsyncRewardClient, InferenceFailedError, ModelInfo
from rfm_gateway import GatewayConfig
from rfm_gateway.body import Batch
from rfm_gateway.config import MIB
from rfm_gateway.mounting import BodyLimits
from rfm_gateway.schema import SAMPLES
from rfm_gateway.scoring import Evaluator
from rfm_gateway.state import TritonState
from shelves import V2, Shelf

NUM_FRAMES = 4


class Rollout(Shelf):
    """A server in whose second version two frames share a value."""

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        info = await super().model_info(model, timeout_s)
        return replace(info, frames_per_value=1 + (info.versions == (V2.version,)))


def test_values_are_those_of_the_version_that_answers() -> None:
    async def ask() -> None:
        async with AsyncRewardClient("", transports=[Rollout(after=1)], retry=False) as client:
            config = GatewayConfig(triton="grpc://127.0.0.1:1", metrics_url="http://127.0.0.1:1/metrics")
            state = TritonState(client, config)
            batch = Batch(
                SAMPLES.validate_python([progress(filmed(1, NUM_FRAMES, size_px=8))], context={}),
                [("samples", 0)],
                False,
            )
            evaluator = Evaluator(client, BodyLimits(MIB, 60.0))
            first, second = [(await evaluator.evaluate(batch, "request"))[0] for _ in range(2)]
            assert first.outputs_progress is not None and second.outputs_progress is not None
            np.testing.assert_allclose(first.outputs_progress.progress_pred, [[0.1] * NUM_FRAMES], rtol=1e-6)
            np.testing.assert_allclose(second.outputs_progress.progress_pred, [[0.9] * (NUM_FRAMES // 2)], rtol=1e-6)
            assert (await state.model_info()).model_version == V2.version

    asyncio.run(ask())


class Baseline(Rollout):
    """A server of RoboReward that takes one sample a request. The gateway shows it each prefix of an episode."""

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        return replace(await super().model_info(model, timeout_s), scores_whole_prefixes=True, max_batch_size=1)


def test_prefixes_that_several_versions_scored_are_no_curve() -> None:
    async def ask() -> None:
        async with AsyncRewardClient("", transports=[Baseline(after=1)], retry=False) as client:
            batch = Batch(
                SAMPLES.validate_python([progress(filmed(1, NUM_FRAMES, size_px=8))], context={}),
                [("samples", 0)],
                True,
            )
            with pytest.raises(InferenceFailedError, match="model_version: expected one for all frames, got "):
                await Evaluator(client, BodyLimits(MIB, 60.0)).evaluate(batch, "request")
            answer, _ = await Evaluator(client, BodyLimits(MIB, 60.0)).evaluate(batch, "request")
            assert answer.outputs_progress is not None
            assert len(answer.outputs_progress.progress_pred[0]) == NUM_FRAMES

    asyncio.run(ask())
