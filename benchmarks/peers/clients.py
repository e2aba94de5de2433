# SPDX-License-Identifier: MIT
"""Clients for the peers, used by a load generator.

Each factory takes a session and the server's address. It returns a coroutine function that scores embedding samples
together: progress at the last frame, preference or similarity. It raises an error if a sample has no score.
"""

from __future__ import annotations

import asyncio
import io
import json
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any, TypeAlias

import aiohttp
import msgpack
import numpy as np

from rfm_client import PreferenceSample, ProgressSample, Sample, SimilaritySample, Trajectory

Ask: TypeAlias = Callable[[Sequence[Sample]], Awaitable[list[float]]]

KINDS: dict[type, str] = {
    ProgressSample: "progress",
    PreferenceSample: "preference",
    SimilaritySample: "similarity",
}
NAMES: dict[type, tuple[str, ...]] = {  # what the evaluation server calls their trajectories
    ProgressSample: ("trajectory",),
    PreferenceSample: ("chosen_trajectory", "rejected_trajectory"),
    SimilaritySample: ("ref_trajectory", "sim_trajectory"),
}
_MSGPACK = {"Content-Type": "application/msgpack"}


def fastapi_npy(session: aiohttp.ClientSession, base_url: str) -> Ask:
    """Return a client for the FastAPI evaluation server, or for our gateway, with .npy files in a form."""

    async def ask(samples: Sequence[Sample]) -> list[float]:
        async with session.post(f"{base_url}/evaluate_batch_npy", data=_form(samples)) as answer:
            answer.raise_for_status()
            return _scores(samples, await answer.json())

    return ask


def by_msgpack(session: aiohttp.ClientSession, url: str) -> Ask:
    """Return a client for the mosec server, with one message per sample (see ``engines``)."""

    async def ask_one(sample: Sample) -> float:
        videos = [_video(trajectory) for trajectory in sample.trajectories]
        message = {
            "type": KINDS[type(sample)],
            "shapes": [video.shape for video in videos],
            "video": b"".join(video.tobytes() for video in videos),
            "text": _text(sample.trajectories[0]).tobytes(),
        }
        async with session.post(url, data=msgpack.packb(message), headers=_MSGPACK) as answer:
            answer.raise_for_status()
            scores = msgpack.unpackb(await answer.read())
        if "error" in scores:
            raise RuntimeError(scores["error"])
        if isinstance(sample, ProgressSample):
            return float(np.frombuffer(scores["progress"][0], np.float32)[-1])
        return float(scores["query"])

    async def ask(samples: Sequence[Sample]) -> list[float]:
        return list(await asyncio.gather(*map(ask_one, samples)))

    return ask


def _video(trajectory: Trajectory) -> np.ndarray:
    assert trajectory.video_embeddings is not None
    return trajectory.video_embeddings


def _text(trajectory: Trajectory) -> np.ndarray:
    assert trajectory.text_embedding is not None
    return trajectory.text_embedding


def _form(samples: Sequence[Sample]) -> aiohttp.FormData:
    """Return a request for the multipart endpoint."""
    form = aiohttp.FormData()
    for index, sample in enumerate(samples):
        described: dict[str, Any] = {"sample_type": KINDS[type(sample)]}
        for name, trajectory in zip(NAMES[type(sample)], sample.trajectories, strict=True):
            arrays = {"video_embeddings": _video(trajectory), "text_embedding": _text(trajectory)}
            keys = {kind: f"sample_{index}_{name}_{kind}" for kind in arrays}
            for kind, key in keys.items():
                file = io.BytesIO()
                np.save(file, arrays[kind])
                form.add_field(key, file.getvalue(), filename=f"{key}.npy", content_type="application/octet-stream")
            described[name] = {kind: {"__numpy_file__": key} for kind, key in keys.items()}
        form.add_field(f"sample_{index}", json.dumps(described))
    return form


def _scores(samples: Sequence[Sample], outputs: Mapping[str, Any]) -> list[float]:
    """Return the scores in sample order. The evaluation server answers with one list per sample type."""
    told = {
        "progress": (values[-1] for values in (outputs["outputs_progress"] or {}).get("progress_pred", ())),
        "preference": iter((outputs["outputs_preference"] or {}).get("prediction_probs", ())),
        "similarity": iter((outputs["outputs_similarity"] or {}).get("sim_score_ref_sim", ())),
    }
    return [float(next(told[KINDS[type(sample)]])) for sample in samples]
