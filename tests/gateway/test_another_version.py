# SPDX-License-Identifier: MIT
"""The checkpoint is replaced while the gateway asks. A stand-in replaces it when a test wants."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, replace

import numpy as np
import pytest

from gateway_requests import filmed, progress
from rfm_client import AsyncRewardClient, ServerUnavailableError
from rfm_client.contract.model_info import ModelInfo
from rfm_gateway.body import Batch
from rfm_gateway.schema import SAMPLES, EvaluateBatchAnswer
from rfm_gateway.scoring import Evaluator
from rfm_gateway.state import TritonState
from shelves import V2, Shelf

NUM_FRAMES = 4


@dataclass
class Rollout(Shelf):
    """A server in whose second version two frames share a value. versions: that it says it serves; None: the newest"""

    versions: tuple[str, ...] | None = None

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        info = await super().model_info(model, timeout_s)
        group = 1 + (info.versions == (V2.version,))
        return replace(info, versions=self.versions or info.versions, frames_per_value=group)


async def answers(client: AsyncRewardClient, count: int) -> list[EvaluateBatchAnswer]:
    sample = progress(filmed(1, NUM_FRAMES, size_px=8))
    batch = Batch(SAMPLES.validate_python([sample], context={}), False)
    evaluator = Evaluator(client, 60.0)
    return [await evaluator.evaluate(batch, "request") for _ in range(count)]


def test_values_are_those_of_the_version_that_answers() -> None:
    async def ask() -> None:
        async with AsyncRewardClient("", transports=[Rollout(after=1)], retry=False) as client:
            state = TritonState(client, "grpc://127.0.0.1:1", "http://127.0.0.1:1/metrics", "rfm")
            first, second = await answers(client, 2)
            assert first.outputs_progress is not None and second.outputs_progress is not None
            np.testing.assert_allclose(first.outputs_progress.progress_pred, [[0.1] * NUM_FRAMES], rtol=1e-6)
            np.testing.assert_allclose(second.outputs_progress.progress_pred, [[0.9] * (NUM_FRAMES // 2)], rtol=1e-6)
            assert (await state.model_info()).model_version == V2.version

    asyncio.run(ask())


def test_a_version_of_which_nothing_is_told_is_to_be_asked_again() -> None:
    async def ask() -> None:
        async with AsyncRewardClient("", transports=[Rollout(versions=("2",))], retry=False) as client:
            await answers(client, 1)

    with pytest.raises(ServerUnavailableError, match="expected one of 2, got 1: the checkpoint is being replaced"):
        asyncio.run(ask())
