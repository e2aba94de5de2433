# SPDX-License-Identifier: MIT
"""How a caller asks each peer: functions for a load generator.

Each factory takes a session and the server's address, and gives a coroutine function from samples of embeddings, which
are asked about together, to the progress at the last frame, the preference or the similarity of each. Failures are
raised.
"""

from __future__ import annotations

import asyncio
import io
import json
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import aiohttp
import msgpack
import numpy as np

from rfm_client import PreferenceSample, ProgressSample, Sample, Trajectory

Ask: TypeAlias = Callable[[Sequence[Sample]], Awaitable[list[float]]]

_MSGPACK = {"Content-Type": "application/msgpack"}


def fastapi_npy(session: aiohttp.ClientSession, base_url: str) -> Ask:
    """Asks the FastAPI evaluation server, or our gateway, with .npy files in a form."""

    async def ask(samples: Sequence[Sample]) -> list[float]:
        async with session.post(f"{base_url}/evaluate_batch_npy", data=_form(samples)) as answer:
            answer.raise_for_status()
            return _scores(samples, await answer.json())

    return ask


def by_msgpack(session: aiohttp.ClientSession, url: str) -> Ask:
    """Asks the LitServe or mosec server with a message a sample, as ``engines`` describes it."""

    async def ask_one(sample: Sample) -> float:
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

    async def ask(samples: Sequence[Sample]) -> list[float]:
        return list(await asyncio.gather(*map(ask_one, samples)))

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


def _arrays(sample: Sample) -> Iterator[tuple[str, str, np.ndarray]]:
    """Each array, with the names of its trajectory and of its own."""
    for name, trajectory in _named(sample).items():
        yield name, "video_embeddings", _video(trajectory)
        yield name, "text_embedding", _text(trajectory)


def _form(samples: Sequence[Sample]) -> aiohttp.FormData:
    """A request of the multipart endpoint."""
    form = aiohttp.FormData()
    for index, sample in enumerate(samples):
        described: dict[str, Any] = {"sample_type": _kind(sample)}
        for name, kind, array in _arrays(sample):
            key = f"sample_{index}_{name}_{kind}"
            file = io.BytesIO()
            np.save(file, array)
            form.add_field(key, file.getvalue(), filename=f"{key}.npy", content_type="application/octet-stream")
            described.setdefault(name, {})[kind] = {"__numpy_file__": key}
        form.add_field(f"sample_{index}", json.dumps(described))
    return form


def _scores(samples: Sequence[Sample], outputs: Mapping[str, Any]) -> list[float]:
    """From an answer of the evaluation server, which has the samples of each type in a list of their own."""
    told = {
        "progress": (values[-1] for values in (outputs["outputs_progress"] or {}).get("progress_pred", ())),
        "preference": iter((outputs["outputs_preference"] or {}).get("prediction_probs", ())),
        "similarity": iter((outputs["outputs_similarity"] or {}).get("sim_score_ref_sim", ())),
    }
    return [float(next(told[_kind(sample)])) for sample in samples]
