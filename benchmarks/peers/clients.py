# SPDX-License-Identifier: MIT
"""Clients for the peers, used by a load generator.

Each factory takes a session and the server's address. It returns a coroutine function that scores a sample with
embeddings: progress at the last frame, preference or similarity. It raises an error if there is no score.
"""

from __future__ import annotations

import io
import json
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, TypeAlias

import aiohttp
import msgpack
import numpy as np

from rfm_client import PreferenceSample, ProgressSample, Sample, SimilaritySample, Trajectory

Ask: TypeAlias = Callable[[Sample], Awaitable[float]]

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

    async def ask(sample: Sample) -> float:
        async with session.post(f"{base_url}/evaluate_batch_npy", data=_form(sample)) as answer:
            answer.raise_for_status()
            return _score(sample, await answer.json())

    return ask


def by_msgpack(session: aiohttp.ClientSession, url: str) -> Ask:
    """Return a client for the mosec server, with one message per sample (see ``engines``)."""

    async def ask(sample: Sample) -> float:
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

    return ask


def _video(trajectory: Trajectory) -> np.ndarray:
    assert trajectory.video_embeddings is not None
    return trajectory.video_embeddings


def _text(trajectory: Trajectory) -> np.ndarray:
    assert trajectory.text_embedding is not None
    return trajectory.text_embedding


def _form(sample: Sample) -> aiohttp.FormData:
    """Return a request for the multipart endpoint."""
    form = aiohttp.FormData()
    described: dict[str, Any] = {"sample_type": KINDS[type(sample)]}
    for name, trajectory in zip(NAMES[type(sample)], sample.trajectories, strict=True):
        arrays = {"video_embeddings": _video(trajectory), "text_embedding": _text(trajectory)}
        keys = {kind: f"sample_0_{name}_{kind}" for kind in arrays}
        for kind, key in keys.items():
            file = io.BytesIO()
            np.save(file, arrays[kind])
            form.add_field(key, file.getvalue(), filename=f"{key}.npy", content_type="application/octet-stream")
        described[name] = {kind: {"__numpy_file__": key} for kind, key in keys.items()}
    form.add_field("sample_0", json.dumps(described))
    return form


def _score(sample: Sample, outputs: Mapping[str, Any]) -> float:
    if isinstance(sample, ProgressSample):
        return float(outputs["outputs_progress"]["progress_pred"][0][-1])
    if isinstance(sample, PreferenceSample):
        return float(outputs["outputs_preference"]["prediction_probs"][0])
    return float(outputs["outputs_similarity"]["sim_score_ref_sim"][0])
