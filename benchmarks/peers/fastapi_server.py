# SPDX-License-Identifier: MIT
"""The design of the FastAPI evaluation server, with one replica on the CPU.

As in its README: a pool of identical replicas, a thread pool for checkout and inference, and a free replica for each
request alone. Samples of different requests never share a forward pass. All samples of a type in a request have the
same length. A bad sample fails its whole request. Only the faster endpoint, npy, is here.
"""

from __future__ import annotations

import asyncio
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import Queue
from typing import Any

import numpy as np
import torch
import uvicorn
from fastapi import FastAPI, Request
from starlette.datastructures import UploadFile
from torch import Tensor
from upstream_forward import Scores, UpstreamRewind, load, progress_of

from engines import options

UPLOAD_KEY = "__numpy_file__"
TRAJECTORIES = {  # for each sample type, in the network's order
    "progress": ("trajectory",),
    "preference": ("chosen_trajectory", "rejected_trajectory"),
    "similarity": ("ref_trajectory", "sim_trajectory"),
}

Json = Mapping[str, Any]


class ReplicaPool:
    """Replicas, each checked out for one request at a time, and the threads that score."""

    def __init__(self, replicas: Sequence[UpstreamRewind], max_workers: int) -> None:
        self._replicas: Queue[UpstreamRewind] = Queue()
        for replica in replicas:
            self._replicas.put(replica)
        self._threads = ThreadPoolExecutor(max_workers)

    async def evaluate(self, samples: Sequence[Json]) -> Json:
        """Return the answer to a request, scored in a thread."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, self._evaluate, samples)

    def _evaluate(self, samples: Sequence[Json]) -> Json:
        replica = self._replicas.get()
        try:
            return _score(replica, samples)
        finally:
            self._replicas.put(replica)


def create_app(pool: ReplicaPool) -> FastAPI:
    """Return the application with the npy endpoint."""
    app = FastAPI()

    @app.post("/evaluate_batch_npy")
    async def evaluate_batch_npy(request: Request) -> Json:
        """Score the samples in the fields sample_0, sample_1 and so on. Their arrays are .npy uploads."""
        arrays: dict[str, np.ndarray] = {}
        fields: dict[str, Any] = {}
        async with request.form() as form:
            for name, value in form.items():
                if isinstance(value, UploadFile):
                    arrays[name] = np.load(io.BytesIO(await value.read()), allow_pickle=False)
                elif name.startswith("sample_"):
                    fields[name] = json.loads(value)
        return await pool.evaluate([_merged(fields[f"sample_{index}"], arrays) for index in range(len(fields))])

    return app


def _merged(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Replace array names in the value with the uploaded arrays."""
    if not isinstance(value, dict):
        return value
    if UPLOAD_KEY in value:
        return arrays[value[UPLOAD_KEY]]
    return {name: _merged(part, arrays) for name, part in value.items()}


@torch.inference_mode()
def _score(network: UpstreamRewind, samples: Sequence[Json]) -> Json:
    """Return the answer to a request, with one forward pass per sample type."""
    outputs = ("outputs_preference", "outputs_progress", "outputs_success", "outputs_similarity")
    answer: dict[str, Any] = dict.fromkeys(outputs)
    for kind in TRAJECTORIES:
        of_kind = [sample for sample in samples if sample["sample_type"] == kind]
        if not of_kind:
            continue
        scores = _forward(network, of_kind, kind)
        if kind == "progress":
            answer["outputs_progress"] = {"progress_pred": progress_of(scores.progress).tolist()}
            answer["outputs_success"] = {"success_probs": scores.success.sigmoid().tolist()}
        elif kind == "preference":
            answer["outputs_preference"] = {"prediction_probs": scores.query.sigmoid().tolist()}
        else:
            answer["outputs_similarity"] = {"sim_score_ref_sim": scores.query.tolist()}
    return answer


def _forward(network: UpstreamRewind, samples: Sequence[Json], kind: Any) -> Scores:
    """Return raw scores for samples with one type. Raises RuntimeError if trajectory lengths differ."""
    sides = [[sample[name] for sample in samples] for name in TRAJECTORIES[kind]]
    text = _stacked(trajectory["text_embedding"] for trajectory in sides[0])
    videos = [_stacked(trajectory["video_embeddings"] for trajectory in side) for side in sides]
    return network(text, *videos, sample_type=kind)


def _stacked(arrays: Iterable[Any]) -> Tensor:
    return torch.stack([torch.as_tensor(array, dtype=torch.float32) for array in arrays])


def main() -> None:
    """Serve until SIGTERM."""
    arguments = options(__doc__)
    torch.set_num_threads(arguments.threads)
    torch.set_num_interop_threads(1)
    pool = ReplicaPool([load(arguments.checkpoint)], max_workers=1)  # more workers than replicas would wait
    uvicorn.run(create_app(pool), host="127.0.0.1", port=arguments.port, log_level="warning", access_log=False)


if __name__ == "__main__":
    main()
