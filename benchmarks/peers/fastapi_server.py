# SPDX-License-Identifier: MIT
"""The design of the FastAPI evaluation server, with one replica on the CPU.

As its README tells it: identical replicas in a pool, a thread pool for checkout and inference, and each request's batch
farmed to whichever replica is free, which it then has to itself. Samples of different requests never share a forward,
all samples of a kind in a request have one length, and a request with a bad sample fails as a whole.
"""

from __future__ import annotations

import argparse
import asyncio
import io
import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import Queue
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
import torch
import uvicorn
from fastapi import Body, FastAPI, Request
from pydantic import BaseModel, Field, TypeAdapter
from starlette.datastructures import UploadFile
from torch import Tensor
from upstream_forward import SampleType, Scores, UpstreamRewind, load, progress_of

UPLOAD_KEY = "__numpy_file__"

Answer: TypeAlias = dict[str, Any]


class Trajectory(BaseModel):
    """video_embeddings: [T, Dv] and text_embedding: [Dt], nested lists or arrays."""

    video_embeddings: Any
    text_embedding: Any
    task: str | None = None
    frames_shape: list[int] | None = None
    target_progress: list[float] | None = None


class ProgressSample(BaseModel):
    """How far has the trajectory come?"""

    sample_type: Literal["progress"]
    trajectory: Trajectory

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """In the order in which the network reads them."""
        return (self.trajectory,)


class PreferenceSample(BaseModel):
    """Which trajectory is better?"""

    sample_type: Literal["preference"]
    chosen_trajectory: Trajectory
    rejected_trajectory: Trajectory

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """In the order in which the network reads them."""
        return (self.chosen_trajectory, self.rejected_trajectory)


class SimilaritySample(BaseModel):
    """How similar are the trajectories?"""

    sample_type: Literal["similarity"]
    ref_trajectory: Trajectory
    sim_trajectory: Trajectory

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """In the order in which the network reads them."""
        return (self.ref_trajectory, self.sim_trajectory)


Sample: TypeAlias = ProgressSample | PreferenceSample | SimilaritySample
SAMPLES: TypeAdapter[list[Sample]] = TypeAdapter(list[Annotated[Sample, Field(discriminator="sample_type")]])


class ReplicaPool:
    """Replicas that are checked out for a request each, and the threads that do it."""

    def __init__(self, replicas: Sequence[UpstreamRewind], max_workers: int) -> None:
        self.size = len(replicas)
        self._replicas: Queue[UpstreamRewind] = Queue()
        for replica in replicas:
            self._replicas.put(replica)
        self._threads = ThreadPoolExecutor(max_workers)

    @property
    def num_available(self) -> int:
        """Replicas that no request has."""
        return self._replicas.qsize()

    async def evaluate(self, samples: Sequence[Sample]) -> Answer:
        """The answer to a request, scored in a thread."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, self._evaluate, samples)

    def _evaluate(self, samples: Sequence[Sample]) -> Answer:
        replica = self._replicas.get()
        try:
            return _score(replica, samples)
        finally:
            self._replicas.put(replica)


def create_app(pool: ReplicaPool) -> FastAPI:
    """The application."""
    app = FastAPI()

    @app.post("/evaluate_batch")
    async def evaluate_batch(payload: Annotated[Any, Body()]) -> Answer:
        """Scores {"samples": [...]}, or a bare list of samples."""
        samples = payload["samples"] if isinstance(payload, dict) else payload
        return await pool.evaluate(SAMPLES.validate_python(samples))

    @app.post("/evaluate_batch_npy")
    async def evaluate_batch_npy(request: Request) -> Answer:
        """Scores the samples in the fields sample_0, sample_1 and so on, whose arrays are .npy uploads."""
        arrays: dict[str, np.ndarray] = {}
        fields: dict[str, Any] = {}
        async with request.form() as form:
            for name, value in form.items():
                if isinstance(value, UploadFile):
                    arrays[name] = np.load(io.BytesIO(await value.read()), allow_pickle=False)
                elif name.startswith("sample_"):
                    fields[name] = json.loads(value)
        samples = [_merged(fields[f"sample_{index}"], arrays) for index in range(len(fields))]
        return await pool.evaluate(SAMPLES.validate_python(samples))

    @app.get("/health")
    async def health() -> Answer:
        """Tells that the server runs."""
        return {"status": "healthy", "available_gpus": pool.num_available, "total_gpus": pool.size}

    return app


def _merged(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """The value with uploaded arrays in place of their names."""
    if not isinstance(value, dict):
        return value
    if UPLOAD_KEY in value:
        return arrays[value[UPLOAD_KEY]]
    return {name: _merged(part, arrays) for name, part in value.items()}


@torch.inference_mode()
def _score(network: UpstreamRewind, samples: Sequence[Sample]) -> Answer:
    """The answer to the samples of one request: a forward for each kind of sample in it."""
    answer: Answer = dict.fromkeys(
        ("outputs_preference", "outputs_progress", "outputs_success", "outputs_similarity"), None
    )
    progress = [sample for sample in samples if isinstance(sample, ProgressSample)]
    if progress:
        scores = _forward(network, progress, "progress")
        answer["outputs_progress"] = {"progress_pred": progress_of(scores.progress).tolist()}
        answer["outputs_success"] = {"success_probs": scores.success.sigmoid().tolist()}
    preference = [sample for sample in samples if isinstance(sample, PreferenceSample)]
    if preference:
        probabilities = _query(_forward(network, preference, "preference")).sigmoid()
        answer["outputs_preference"] = {
            "predictions": (probabilities > 0.5).int().tolist(),
            "prediction_probs": probabilities.tolist(),
            "preference_labels": [1.0] * len(preference),
        }
    similarity = [sample for sample in samples if isinstance(sample, SimilaritySample)]
    if similarity:
        scores = _forward(network, similarity, "similarity")
        answer["outputs_similarity"] = {"sim_score_ref_sim": _query(scores).tolist()}
    return answer


def _forward(network: UpstreamRewind, samples: Sequence[Sample], sample_type: SampleType) -> Scores:
    text = _stacked([sample.trajectories[0].text_embedding for sample in samples])
    sides = zip(*(sample.trajectories for sample in samples), strict=True)
    videos = [_stacked([trajectory.video_embeddings for trajectory in side]) for side in sides]
    return network(text, *videos, sample_type=sample_type)


def _stacked(arrays: Sequence[Any]) -> Tensor:
    """float32 [B, ...]. Raises RuntimeError for arrays of unequal shapes."""
    return torch.stack([torch.as_tensor(array, dtype=torch.float32) for array in arrays])


def _query(scores: Scores) -> Tensor:
    assert scores.query is not None  # pairs have it
    return scores.query


def main() -> None:
    """Serves until SIGTERM."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", required=True, help="folder of a ReWiND checkpoint")
    parser.add_argument("--port", type=int, default=8200)
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    parser.add_argument("--max-workers", type=int, default=1, help="threads that check out; more than replicas starve")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.set_num_interop_threads(1)
    pool = ReplicaPool([load(arguments.checkpoint)], arguments.max_workers)
    uvicorn.run(create_app(pool), host="127.0.0.1", port=arguments.port, log_level="warning", access_log=False)


if __name__ == "__main__":
    main()
