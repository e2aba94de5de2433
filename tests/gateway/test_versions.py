# SPDX-License-Identifier: MIT
"""The checkpoint is replaced while the gateway asks. The server is a stand-in, whose checkpoint tests replace."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import clip
from gateway_requests import Json, dumped, filmed, preference, progress
from rfm_client import AsyncRewardClient, Trajectory
from rfm_client.contract import wire
from rfm_client.contract.model_info import ModelInfo
from rfm_client.data.sampling import Sampling
from rfm_client.transport.calls import Answer
from rfm_gateway import app
from rfm_gateway.body import Batch
from rfm_gateway.config import GatewayConfig
from rfm_gateway.folder import AllowedFolder
from rfm_gateway.memory import Memory
from rfm_gateway.schema import SAMPLES
from rfm_gateway.scoring import Scorer
from rfm_gateway.versions import CheckpointReplacedError
from rfm_gateway.viewer.curves import Call, curve
from shelves import V1, V2, Kept, Shelf

NUM_FRAMES = 4
TWO_REQUESTS = [progress(filmed(seed, NUM_FRAMES, size_px=8)) for seed in range(100)]
ONE_REQUEST = TWO_REQUESTS[:1]
REPLACED = "model_version: expected one for the whole answer, got 1, 2: the checkpoint is being replaced, try again"


@dataclass
class Rollout(Shelf):
    """A server whose versions differ in how many frames share a value. served: versions that it says it serves"""

    served: tuple[str, ...] | None = None
    groups: tuple[int, int] = (1, 2)  # of either version
    is_torn: bool = False  # requests go to either version in turn, for ever

    def of(self, model: str) -> Kept:
        if self.is_torn:
            return (self.kept, self.other)[self.count % 2]
        return super().of(model)

    async def infer(
        self, model: str, inputs: wire.Tensors, outputs: Collection[str], timeout_s: float, *, request_id: str = ""
    ) -> Answer:
        answer = await super().infer(model, inputs, outputs, timeout_s, request_id=request_id)
        per_sample = {wire.PREFERENCE, wire.SIMILARITY}
        cut = {name: array[:, :1] if name in per_sample else array for name, array in answer.tensors.items()}
        return Answer(cut, answer.model_version)

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        info = await super().model_info(model, timeout_s)
        versions = self.served or info.versions
        return replace(info, versions=versions, frames_per_value=self.groups[versions[-1] == V2.version])


class Asking:
    """The gateway before a stand-in."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, shelf: Shelf) -> None:
        def client(_url: str, **options: Any) -> AsyncRewardClient:
            return AsyncRewardClient("", transports=[shelf], **options)

        monkeypatch.setattr(app, "AsyncRewardClient", client)
        self.shelf = shelf
        self._app = app.create_app(GatewayConfig(triton="grpc://127.0.0.1:1"))

    def post(self, path: str, **body: Any) -> httpx.Response:
        async def ask() -> httpx.Response:
            transport = httpx.ASGITransport(self._app)
            async with self._app.router.lifespan_context(self._app), httpx.AsyncClient(transport=transport) as http:
                return await http.post(f"http://gateway/{path}", **body)

        return asyncio.run(ask())

    def scores(self, samples: list[Json]) -> httpx.Response:
        return self.post("evaluate_batch", content=dumped(samples))


def progress_of(response: httpx.Response) -> list[list[float]]:
    assert response.status_code == 200, response.text
    told: list[list[float]] = response.json()["outputs_progress"]["progress_pred"]
    return told


def check_replaced(response: httpx.Response) -> None:
    assert (response.status_code, response.json()) == (503, {"detail": REPLACED})
    assert response.headers["Retry-After"] == "1"


def near(score: float, num_values: int) -> list[Any]:
    return [pytest.approx(score)] * num_values


def test_a_batch_that_two_versions_answered_is_asked_about_again(monkeypatch: pytest.MonkeyPatch) -> None:
    asking = Asking(monkeypatch, Rollout(after=1))
    told = progress_of(asking.scores(TWO_REQUESTS))
    assert told == [near(V2.score, NUM_FRAMES // 2)] * len(TWO_REQUESTS)
    assert [shape[0] for shape in asking.shelf.shapes] == [64, 36, 64, 36]


def test_the_samples_of_multipart_bodies_are_asked_about_again(monkeypatch: pytest.MonkeyPatch) -> None:
    asking = Asking(monkeypatch, Rollout(after=1))
    files = {f"sample_{index}": (None, dumped(sample)) for index, sample in enumerate(TWO_REQUESTS)}
    response = asking.post("evaluate_batch_npy", files=files)
    assert progress_of(response) == [near(V2.score, NUM_FRAMES // 2)] * len(TWO_REQUESTS)


def test_each_type_of_sample_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = (filmed(seed, NUM_FRAMES, size_px=16) for seed in (1, 2))  # of another size: a request of its own
    response = Asking(monkeypatch, Rollout(after=1)).scores([*ONE_REQUEST, preference(one, other)])
    assert progress_of(response) == [near(V2.score, NUM_FRAMES // 2)]
    assert response.json()["outputs_preference"]["prediction_probs"] == near(V2.score, 1)


def test_a_batch_that_two_versions_answered_twice_is_to_be_sent_again(monkeypatch: pytest.MonkeyPatch) -> None:
    asking = Asking(monkeypatch, Rollout(is_torn=True))
    check_replaced(asking.scores(TWO_REQUESTS))
    assert asking.shelf.count == 4


def test_tasks_that_the_old_version_encoded_are_not_given_to_the_new_one(monkeypatch: pytest.MonkeyPatch) -> None:
    asking = Asking(monkeypatch, Rollout(after=1))
    samples = [progress({"task": "lift", "video_embeddings": np.ones((2, 4))})] * 100
    check_replaced(asking.scores(samples))
    assert asking.shelf.count == 2


def test_frames_share_a_value_as_in_the_version_that_answers_while_both_are_served() -> None:
    shelf = Rollout()

    async def ask() -> None:
        async with AsyncRewardClient("", transports=[shelf]) as client:
            scorer = Scorer(client, AllowedFolder(None, 0), 10.0)
            batch = Batch(SAMPLES.validate_python(ONE_REQUEST, context={}), False)
            for served in (None, ("1", "2")):
                shelf.served = served  # the configuration of both is that of version 2, which still loads
                await client.model_info(frames=True, refresh=True)  # as /health does
                with Memory(2**20).share() as share:
                    answer = await scorer.evaluate(batch, share, "request")
                assert answer.outputs_progress is not None
                assert answer.outputs_progress.progress_pred == [near(V1.score, NUM_FRAMES)]

    asyncio.run(ask())


def test_a_version_of_which_nothing_is_told_any_more_is_to_be_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    check_replaced(Asking(monkeypatch, Rollout(served=("2",))).scores(ONE_REQUEST))


def test_one_version_prefers_in_both_orders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    clip.write(tmp_path / "clip.mp4")
    film = (tmp_path / "clip.mp4").read_bytes()
    body: Json = {"files": {"first": ("a.mp4", film), "second": ("b.mp4", film)}, "data": {"task": clip.TASK}}
    asking = Asking(monkeypatch, Rollout(after=1))
    response = asking.post("viewer/compare", **body)
    assert response.status_code == 200, response.text
    answer = response.json()
    assert answer["model_version"] == V2.version
    assert [order["preference"] for order in answer["orders"]] == near(V2.score, 2)
    check_replaced(Asking(monkeypatch, Rollout(is_torn=True)).post("viewer/compare", **body))


def test_a_curve_ends_where_another_version_answers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    clip.write(tmp_path / "clip.mp4")
    body: Json = {"files": {"video": ("a.mp4", (tmp_path / "clip.mp4").read_bytes())}, "data": {"task": clip.TASK}}
    response = Asking(monkeypatch, Rollout(after=2)).post("viewer/score", **body)
    events = [event.split("\n") for event in response.text.split("\n\n")[:-1]]
    assert [name for name, _ in events] == ["event: video", "event: scores", "event: scores", "event: failed"]
    assert json.loads(events[-1][1].removeprefix("data: ")) == {"detail": REPLACED}


def test_a_part_of_a_curve_that_two_versions_gave_is_not_shown() -> None:
    film = Trajectory(frames=np.zeros((7, 256, 256, 3), np.uint8), task=clip.TASK)
    shelf = Rollout(after=3)  # the third part takes two requests

    async def ask() -> None:
        async with AsyncRewardClient("", transports=[shelf]) as client:
            call = Call(Sampling("rint_pad", 16), 10.0, "request")
            told = []
            with pytest.raises(CheckpointReplacedError, match=r"got 1, 2"):
                async for points in curve(client, film, call):
                    told.append(points)
        assert [points.model_version for points in told] == ["1", "1"]
        assert shelf.count == 4

    asyncio.run(ask())
