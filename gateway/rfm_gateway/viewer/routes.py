# SPDX-License-Identifier: MIT
"""What the page asks: which models are served, the curve of a video, which of two videos does a task better.

A curve comes as server-sent events: ``video`` tells its frames, ``scores`` some points, ``done`` or ``failed`` the end.
"""

from __future__ import annotations

import asyncio
import dataclasses
import json
import logging
import time
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import anyio
from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse
from starlette.datastructures import UploadFile
from starlette.types import Receive, Scope, Send

from rfm_client.async_client import AsyncRewardClient
from rfm_client.contract.errors import InvalidSampleError, RewardError
from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.results import PreferenceResult
from rfm_client.contract.samples import ProgressSample, Trajectory
from rfm_client.data.fitting import fitted
from rfm_client.data.orientation import ORIENTATIONS
from rfm_client.data.sampling import RULES, Rule, Sampling, trained_rule
from rfm_client.transport.status import read_status
from rfm_gateway.body import COMPARE_ENDPOINT, SCORE_ENDPOINT, Admitted, BodyLimits, invalid, parts_of
from rfm_gateway.cancellation import while_connected
from rfm_gateway.config import GatewayConfig
from rfm_gateway.memory import Share
from rfm_gateway.observe import Metrics
from rfm_gateway.versions import of_one_version
from rfm_gateway.viewer.curves import Call, Parts, curve
from rfm_gateway.viewer.models import Models, names_of
from rfm_gateway.viewer.question import DEFAULT_FPS, Question
from rfm_gateway.viewer.videos import Video, read_upload

STATUS_TIMEOUT_S = 5.0
_AS_THEY_COME = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}  # the second for proxies that gather answers

logger = logging.getLogger("rfm_gateway")


@dataclass(frozen=True)
class Behind:
    """What answers for the page. model: the one that is chosen unless the page says otherwise"""

    config: GatewayConfig
    model: str
    models: Models
    limits: BodyLimits
    metrics: Metrics


def viewer_routes(behind: Behind) -> APIRouter:
    """The endpoints of the page. They are its own, and not those of the evaluation server."""
    router = APIRouter(include_in_schema=False)

    @router.get("/viewer/served")
    async def served() -> Response:
        return JSONResponse(await _served(behind))

    @router.post(SCORE_ENDPOINT)
    async def score(request: Request) -> Response:
        with ExitStack() as stack:
            asked = await _asked(behind, request, stack, ("video",))
            asked.share.take(Parts.of(asked.videos[0].frames, asked.sampling).num_bytes)
            call = Call(asked.sampling, behind.config.timeout, request.state.request_id)
            return _Events(_score_events(behind, asked, call), stack.pop_all())

    @router.post(COMPARE_ENDPOINT)
    async def compare(request: Request) -> Response:
        with ExitStack() as stack:
            asked = await _asked(behind, request, stack, ("first", "second"))
            preferences = _preferences(asked, behind.config.timeout, request.state.request_id)
            answer = await while_connected(request, preferences)
        behind.metrics.samples.labels("preference").inc(len(answer["orders"]))
        return JSONResponse(answer)

    return router


async def _served(behind: Behind) -> dict[str, Any]:
    """What the page may ask for. Raises RewardError."""
    config = behind.config
    status = await asyncio.to_thread(
        read_status,
        config.triton_url,
        metrics_url=config.metrics_url,
        timeout_s=STATUS_TIMEOUT_S,
        access=config.access,
    )
    infos = await behind.models.infos(names_of(status.models), STATUS_TIMEOUT_S)
    return {
        "models": [
            {
                "name": name,
                "max_frames": info.max_frames,
                "rule": trained_rule(info.trained_padding),
                "versions": list(info.versions),
                "source": info.source,
            }
            for name, info in infos
        ],
        "model": behind.model,
        "rules": [{"name": rule, "frames": _frames_of(rule)} for rule in RULES],
        "orientations": list(ORIENTATIONS),
        "fps": DEFAULT_FPS,
        "url": config.triton_url,
    }


def _frames_of(rule: Rule) -> int | str | None:
    """The number of frames that a rule has of its own, "any" where the caller says it, None where there is none."""
    try:
        return Sampling(rule).frames
    except ValueError:
        return "any"


@dataclass(frozen=True)
class _Asked:
    """A question, the client that answers it, the videos that it is about, and what it holds of the memory."""

    question: Question
    sampling: Sampling
    client: AsyncRewardClient
    info: ModelInfo
    videos: tuple[Video, ...]
    share: Share

    @property
    def trajectories(self) -> list[Trajectory]:
        """The videos as the client takes them."""
        return [Trajectory(frames=video.frames, task=self.question.task) for video in self.videos]


async def _asked(behind: Behind, request: Request, stack: ExitStack, names: tuple[str, ...]) -> _Asked:
    """What a request asks. It holds its share of the memory as long as ``stack``.

    Raises RequestValidationError, HTTPException, RewardError.
    """
    timeout_s = behind.config.timeout
    admitted = stack.enter_context(behind.limits.admitted(request))
    await admitted.wait_for_room(request.state.begin_by)
    with anyio.fail_after(timeout_s) as arrival:
        async with parts_of(admitted) as (fields, uploads):
            arrival.deadline = float("inf")  # all of it has come
            question = Question.of(fields, behind.model)
            client, info = await behind.models.client(question.model, timeout_s)
            sampling = question.sampling(info)
            videos = await while_connected(request, _videos(admitted, uploads, names, question, timeout_s))
    return _Asked(question, sampling, client, info, videos, admitted.share)


async def _videos(
    admitted: Admitted, uploads: Mapping[str, UploadFile], names: Sequence[str], question: Question, timeout_s: float
) -> tuple[Video, ...]:
    """The videos of these names. Raises RequestValidationError, also for one that takes too long to read.

    A thread that reads one that nobody waits for ends at its next frame: the request's share of the memory is over.
    """
    with anyio.move_on_after(timeout_s):
        return tuple([await _video(admitted, uploads, name, question) for name in names])
    raise invalid((names[0],), f"expected videos that are read within {timeout_s:g} s, got longer ones")


async def _video(admitted: Admitted, uploads: Mapping[str, UploadFile], name: str, question: Question) -> Video:
    if name not in uploads:
        raise invalid((name,), "expected a video file, got none")
    try:
        return await read_upload(uploads[name], question.fps, admitted.share.take, question.orient)
    except InvalidSampleError as error:
        where, _, message = error.message.partition(": ")
        raise invalid((name if where == "video" else where,), message) from None


async def _score_events(behind: Behind, asked: _Asked, call: Call) -> AsyncIterator[str]:
    """The events of one curve. What goes wrong is the last of them: the status of the answer has been sent."""
    (video,), (trajectory,) = asked.videos, asked.trajectories
    began_s = time.monotonic()
    times_s = None if video.times_s is None else video.times_s.tolist()
    yield _event("video", {"num_frames": len(video.frames), "times_s": times_s, "sampled_frames": call.sampling.frames})
    version = None
    try:
        sample = ProgressSample(trajectory)
        fit = await asyncio.to_thread(fitted, sample, asked.info, subsample=False, resize=asked.question.resize)
        async for points in curve(asked.client, fit.sample.trajectories[0], call):
            version = points.model_version
            behind.metrics.samples.labels("progress").inc(len(points.progress))
            yield _event("scores", dataclasses.asdict(points))
    except RewardError as error:
        yield _event("failed", {"detail": str(error)})
    except Exception as error:
        logger.error("request %s: unexpected", call.request_id, exc_info=error)
        yield _event("failed", {"detail": "the gateway failed; its log has the reason"})
    else:
        yield _event("done", {"model_version": version, "took_s": time.monotonic() - began_s})


async def _preferences(asked: _Asked, timeout_s: float, request_id: str) -> dict[str, Any]:
    """What one version of the model prefers when it is asked in one order and in the other. Raises RewardError."""
    first, second = asked.trajectories

    async def preferred(one: Trajectory, other: Trajectory) -> PreferenceResult:
        return await asked.client.preference(
            one, other, subsample=True, resize=asked.question.resize, timeout_s=timeout_s, request_id=request_id
        )

    async def both() -> Sequence[PreferenceResult]:
        return await asyncio.gather(preferred(first, second), preferred(second, first))

    try:
        results = await of_one_version(both)
    except InvalidSampleError as error:
        where, _, message = error.message.partition(": ")
        raise invalid((where,), message) from None
    orders = (("first", "second"), ("second", "first"))
    pair = PreferenceResult.of_both_orders(*results)
    return {
        "orders": [
            {"asked": names, "preference": result.preference} for names, result in zip(orders, results, strict=True)
        ],
        "verdict": pair.verdict,
        "orders_agree": pair.orders_agree,
        "model_version": pair.model_version,
    }


def _event(name: str, document: Mapping[str, Any]) -> str:
    return f"event: {name}\ndata: {json.dumps(document, allow_nan=False)}\n\n"


class _Events(StreamingResponse):
    """Server-sent events. ``held`` ends with the answer, also if nobody reads it."""

    def __init__(self, events: AsyncIterator[str], held: ExitStack) -> None:
        super().__init__(events, media_type="text/event-stream", headers=_AS_THEY_COME)
        self._held = held

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Sends the events as they come."""
        with self._held:
            await super().__call__(scope, receive, send)
