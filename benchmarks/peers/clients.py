# SPDX-License-Identifier: MIT
"""How a caller asks each peer about one sample: functions for a load generator.

Each factory takes a session and the server's address, and gives a coroutine function from a sample of embeddings to
the progress at its last frame, its preference or its similarity. Failures are raised.
"""

from __future__ import annotations

import io
import json
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, TypeAlias

import aiohttp
import msgpack
import numpy as np

from rfm_client import PreferenceSample, ProgressSample, Sample, Trajectory

Ask: TypeAlias = Callable[[Sample], Awaitable[float]]

_MSGPACK = {"Content-Type": "application/msgpack"}


def fastapi_json(session: aiohttp.ClientSession, base_url: str) -> Ask:
    """Asks the FastAPI evaluation server, or the gateway, with numbers as JSON."""

    async def ask(sample: Sample) -> float:
        fields = {
            name: {"video_embeddings": _video(trajectory).tolist(), "text_embedding": _text(trajectory).tolist()}
            for name, trajectory in _named(sample).items()
        }
        body = {"samples": [{"sample_type": _kind(sample), **fields}]}
        async with session.post(f"{base_url}/evaluate_batch", json=body) as answer:
            answer.raise_for_status()
            return _score(sample, await answer.json())

    return ask


def fastapi_npy(session: aiohttp.ClientSession, base_url: str) -> Ask:
    """Asks the FastAPI evaluation server with .npy files in a form."""

    async def ask(sample: Sample) -> float:
        async with session.post(f"{base_url}/evaluate_batch_npy", data=_form(sample)) as answer:
            answer.raise_for_status()
            return _score(sample, await answer.json())

    return ask


gateway_npy = fastapi_npy  # our gateway speaks the same


def litserve(session: aiohttp.ClientSession, base_url: str) -> Ask:
    """Asks the LitServe server."""
    return _by_msgpack(session, f"{base_url}/predict")


def mosec(session: aiohttp.ClientSession, base_url: str) -> Ask:
    """Asks the mosec server."""
    return _by_msgpack(session, f"{base_url}/inference")


def _by_msgpack(session: aiohttp.ClientSession, url: str) -> Ask:
    """Asks with a message as ``message`` describes it."""

    async def ask(sample: Sample) -> float:
        videos = [_video(trajectory) for trajectory in sample.trajectories]
        message = {
            "type": _kind(sample),
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


def _kind(sample: Sample) -> str:
    if isinstance(sample, ProgressSample):
        return "progress"
    return "preference" if isinstance(sample, PreferenceSample) else "similarity"


def _named(sample: Sample) -> dict[str, Trajectory]:
    """The trajectories under the evaluation server's names."""
    if isinstance(sample, ProgressSample):
        return {"trajectory": sample.trajectory}
    if isinstance(sample, PreferenceSample):
        return {"chosen_trajectory": sample.first, "rejected_trajectory": sample.second}
    return {"ref_trajectory": sample.reference, "sim_trajectory": sample.other}


def _video(trajectory: Trajectory) -> np.ndarray:
    assert trajectory.video_embeddings is not None
    return trajectory.video_embeddings


def _text(trajectory: Trajectory) -> np.ndarray:
    assert trajectory.text_embedding is not None
    return trajectory.text_embedding


def _form(sample: Sample) -> aiohttp.FormData:
    """A request of the multipart endpoint."""
    form = aiohttp.FormData()
    described: dict[str, Any] = {"sample_type": _kind(sample)}
    for name, trajectory in _named(sample).items():
        described[name] = {}
        for kind, array in (("video_embeddings", _video(trajectory)), ("text_embedding", _text(trajectory))):
            key = f"sample_0_{name}_{kind}"
            file = io.BytesIO()
            np.save(file, array)
            form.add_field(key, file.getvalue(), filename=f"{key}.npy", content_type="application/octet-stream")
            described[name][kind] = {"__numpy_file__": key}
    form.add_field("sample_0", json.dumps(described))
    return form


def _score(sample: Sample, outputs: Mapping[str, Any]) -> float:
    """From an answer of the evaluation server."""
    if isinstance(sample, ProgressSample):
        return float(outputs["outputs_progress"]["progress_pred"][0][-1])
    if isinstance(sample, PreferenceSample):
        return float(outputs["outputs_preference"]["prediction_probs"][0])
    return float(outputs["outputs_similarity"]["sim_score_ref_sim"][0])
