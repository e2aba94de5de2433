# SPDX-License-Identifier: MIT
"""Clients for the peers, used by a load generator.

Each factory takes a session and the server's address. It returns a coroutine function that gives the last frame's
progress for a sample with embeddings. It raises an error if there is no score.
"""

from __future__ import annotations

import io
import json
from collections.abc import Awaitable, Callable
from typing import Any, TypeAlias

import aiohttp
import msgpack
import numpy as np

from rfm_client import Sample

Ask: TypeAlias = Callable[[Sample], Awaitable[float]]

_MSGPACK = {"Content-Type": "application/msgpack"}


def fastapi_npy(session: aiohttp.ClientSession, base_url: str) -> Ask:
    """Return a client for the FastAPI evaluation server, or for our gateway, with .npy files in a form."""

    async def ask(sample: Sample) -> float:
        async with session.post(f"{base_url}/evaluate_batch_npy", data=_form(sample)) as answer:
            answer.raise_for_status()
            return float((await answer.json())["outputs_progress"]["progress_pred"][0][-1])

    return ask


def by_msgpack(session: aiohttp.ClientSession, url: str) -> Ask:
    """Return a client for the mosec server (see ``mosec_server``)."""

    async def ask(sample: Sample) -> float:
        video, text = _arrays(sample).values()
        message = {"shape": video.shape, "video": video.tobytes(), "text": text.tobytes()}
        async with session.post(url, data=msgpack.packb(message), headers=_MSGPACK) as answer:
            answer.raise_for_status()
            scores = msgpack.unpackb(await answer.read())
        if "error" in scores:
            raise RuntimeError(scores["error"])
        return float(np.frombuffer(scores["progress"], np.float32)[-1])

    return ask


def _arrays(sample: Sample) -> dict[str, np.ndarray]:
    (trajectory,) = sample.trajectories
    arrays = {name: getattr(trajectory, name) for name in ("video_embeddings", "text_embedding")}
    assert all(array is not None for array in arrays.values())
    return arrays


def _form(sample: Sample) -> aiohttp.FormData:
    """Return a request for the multipart endpoint."""
    form, keys = aiohttp.FormData(), dict[str, Any]()
    for name, array in _arrays(sample).items():
        file, key = io.BytesIO(), f"sample_0_trajectory_{name}"
        np.save(file, array)
        form.add_field(key, file.getvalue(), filename=f"{key}.npy", content_type="application/octet-stream")
        keys[name] = {"__numpy_file__": key}
    form.add_field("sample_0", json.dumps({"sample_type": "progress", "trajectory": keys}))
    return form
