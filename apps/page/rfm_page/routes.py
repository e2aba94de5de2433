# SPDX-License-Identifier: MIT
"""The page's endpoints for videos: served models, a video's curve, the comparison between two videos.

A curve comes as server-sent events: ``video`` has its frames, ``scores`` some points, ``done`` or ``failed`` ends it.
Each frame is scored on its prefix, a few prefixes at a time.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import math
import shlex
import time
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast, get_args

import anyio
from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse
from pydantic_core import to_json

from rfm_client import (
    FRAME_SCORES,
    AsyncRewardClient,
    InvalidSampleError,
    ModelInfo,
    ModelNotFoundError,
    PreferenceResult,
    ProgressResult,
    ProgressSample,
    Ranking,
    RewardError,
    ServerError,
    Trajectory,
)
from rfm_client.frames import BlankFrames, ChannelOrder, Orientation, Rule, Sampling, resize_frames
from rfm_client.serving import off_loop
from rfm_gateway.mounting import GatewayConfig, PageHost, Upload, invalid, while_connected
from rfm_page.questions import DEFAULT_FPS, ShownVideo, VideoRequest

MIN_COMPARED, MOST_COMPARED = 2, 12  # videos; 12 have 132 questions, and as many colours as the page knows
MOST_PREFIXES = 32  # in a request
MOST_BYTES = 64 * 2**20  # for all frames in a request
STATUS_TIMEOUT_S = 5.0
_AS_THEY_COME = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}  # the second tells proxies not to buffer

_INSTEAD = {name: FRAME_SCORES[name] for name in (score.replaced_by for score in FRAME_SCORES.values()) if name}
_SCORES: dict[str, dict[str, Any]] = {  # what the page's axes need
    name: {
        "short": f"time {score.short(name)}" if score.unit == "s" else score.short(name),
        "unit": score.unit,
        "bounds": [*score.bounds],
    }
    for name, score in _INSTEAD.items()
}
_REPOSITORY, _CHECKPOINT, _DATASET = "my_models", "my_checkpoint", "my_dataset"  # placeholders for the user's paths

logger = logging.getLogger("rfm_gateway")


@dataclass(frozen=True)
class _Asked:
    """A request with its model and videos."""

    question: VideoRequest
    sampling: Sampling
    info: ModelInfo
    videos: tuple[ShownVideo, ...]
    request_id: str


def viewer_routes(host: PageHost) -> APIRouter:
    """Return the page's endpoints for videos. The evaluation server has no such endpoints."""
    config, limits, metrics = host.config, host.limits, host.metrics
    router = APIRouter(include_in_schema=False)

    @router.get("/viewer/server")
    async def server() -> Response:
        rules = [{"name": rule, "frames": _frames_of(rule)} for rule in get_args(Rule)]
        about: dict[str, Any] = {"rules": rules, "orientations": get_args(Orientation)}
        about |= {"channel_orders": get_args(ChannelOrder), "scores": _SCORES, "fps": DEFAULT_FPS}
        return JSONResponse({**about, "url": config.triton_url, "remedies": _remedies(config, host.started_by)})

    @router.get("/viewer/served")
    async def served() -> Response:
        models = [_model_facts(name, info) for name, info in await _infos(config)]
        return JSONResponse({"models": models, "model": config.checkpoint})

    @router.post("/viewer/score", dependencies=[host.place])
    async def score(request: Request) -> Response:
        asked = await read(request, "video")
        return StreamingResponse(events(asked), media_type="text/event-stream", headers=_AS_THEY_COME)

    @router.post("/viewer/compare", dependencies=[host.place])
    async def compare(request: Request) -> Response:
        asked = await read(request)
        async with config.client(asked.question.model) as client:
            answer = await while_connected(request, _ranking(client, asked))
        metrics.samples.labels("preference").inc(len(answer["orders"]))
        return JSONResponse(answer)

    async def read(request: Request, *names: str) -> _Asked:
        """Read a request with the videos under these names; without names, with all its videos.

        Raises RequestValidationError, HTTPException and RewardError.
        """
        fields, uploads = await limits.form(request)
        if not names and not MIN_COMPARED <= len(uploads) <= MOST_COMPARED:
            expected = f"{MIN_COMPARED} to {MOST_COMPARED} video files (rfm-client compare takes more)"
            raise invalid(("videos",), f"expected {expected}, got {len(uploads)}")
        question = VideoRequest.of(fields, config.checkpoint)
        async with config.client(question.model) as client:
            info = await client.model_info(frames=True)
        sampling = question.sampling(info)
        videos = await while_connected(request, decoded(question, uploads, names or tuple(uploads)))
        return _Asked(question, sampling, info, videos, request.state.request_id)

    async def decoded(
        question: VideoRequest, uploads: Mapping[str, Upload], names: tuple[str, ...]
    ) -> tuple[ShownVideo, ...]:
        with limits.decoding() as take, anyio.move_on_after(config.timeout_s):
            return tuple([await question.video(uploads, name, take) for name in names])
        raise invalid((names[0],), f"expected videos that are read within {config.timeout_s:g} s, got longer ones")

    async def events(asked: _Asked) -> AsyncIterator[str]:
        """Yield a curve's events. An error is the last event, because the status has already been sent."""
        (video,) = asked.videos
        num_frames, began_s, version = video.trajectory.num_frames, time.monotonic(), None
        times_s = None if video.times_s is None else video.times_s.tolist()
        blank = await asyncio.to_thread(lambda: BlankFrames(video.trajectory.positions).told)
        about = {"num_frames": num_frames, "times_s": times_s, "sampled_frames": asked.sampling.frames}
        yield _event("video", **about, blank=blank or None)
        try:
            trajectory, size = video.trajectory, asked.info.frame_size if asked.question.resize else None
            if size is not None:
                frames = await asyncio.to_thread(resize_frames, trajectory.positions, size)
                trajectory = replace(trajectory, frames=frames)
            async with config.client(asked.question.model) as client:
                async for points in _curve(client, trajectory, asked):
                    version = points["model_version"]
                    metrics.samples.labels("progress").inc(len(points["progress"]))
                    yield _event("scores", **points)
        except RewardError as error:
            yield _event("failed", detail=str(error), is_servers=isinstance(error, ServerError))
        except Exception as error:
            logger.error("unexpected", exc_info=error)
            yield _event("failed", detail="the gateway failed; its log has the reason", is_servers=False)
        else:
            yield _event("done", model_version=version, took_s=time.monotonic() - began_s)

    return router


async def _infos(config: GatewayConfig) -> list[tuple[str, ModelInfo]]:
    """Return the served models for raw frames, by export name. Raises RewardError."""
    infos = []
    for name in (await config.status(STATUS_TIMEOUT_S)).checkpoints:
        try:
            async with config.client(name) as client:
                infos.append((name, await client.model_info(frames=True, timeout_s=STATUS_TIMEOUT_S)))
        except ModelNotFoundError:  # unloaded in the meantime
            continue
    return infos


def _model_facts(name: str, info: ModelInfo) -> dict[str, Any]:
    usual = Sampling.of(None, 1, None, trained_padding=info.trained_padding).rule
    rule = "all" if info.needs_whole_episode else usual
    about = {"name": name, "max_frames": info.max_frames, "rule": rule}
    about |= {"reads_views": info.reads_views, "has_success": info.has_success}
    about |= {"warning": info.warning, "remedy": info.remedy}
    return {**about, "versions": list(info.versions), "source": info.source}


def _frames_of(rule: Rule) -> int | str | None:
    """Return a rule's own frame count, "any" if the caller chooses it, None if the rule has no such count."""
    try:
        return Sampling(rule).frames
    except ValueError:
        return "any"


async def _curve(client: AsyncRewardClient, trajectory: Trajectory, asked: _Asked) -> AsyncIterator[dict[str, Any]]:
    """Yield the points of a curve, in order. Requests double in size, so that the first point comes soon.

    Raises RewardError.
    """
    assert trajectory.frames is not None
    if asked.info.needs_whole_episode:
        (whole,) = await client.evaluate([ProgressSample(trajectory)], request_id=asked.request_id)
        yield _points(0, [cast(ProgressResult, whole)])
        return
    sampling, frames = asked.sampling, trajectory.frames
    sample_bytes = max(sampling.frames or 0, len(frames)) * math.prod(frames.shape[1:])
    most = max(min(MOST_PREFIXES, MOST_BYTES // sample_bytes), 1)
    samples, first, count = sampling.samples(trajectory), 0, 1

    def following() -> list[ProgressSample]:
        return list(itertools.islice(samples, count))

    while part := await off_loop(count * sample_bytes, following):
        results = cast("list[ProgressResult]", await client.evaluate(part, request_id=asked.request_id))
        reads = [sampling.prefix(t).read for t in range(first, first + len(part))]
        yield _points(first, [result.at(slice(t, t + 1)) for result, t in zip(results, reads, strict=True)])
        first, count = first + len(part), min(2 * count, most)


def _points(first: int, parts: Sequence[ProgressResult]) -> dict[str, Any]:
    """Return a curve's points from frame ``first`` on. Raises InferenceFailedError for several versions."""
    points = ProgressResult.of_parts(parts)
    return {
        "first": first,
        "leading": points.leading,
        **{name: points.arrays[name].tolist() for name in {"progress", points.leading}},
        "success": points.success.tolist(),
        "answered": points.is_answered.tolist(),
        "model_version": points.model_version,
    }


async def _ranking(client: AsyncRewardClient, asked: _Asked) -> dict[str, Any]:
    """Return the ranking of the videos, under the names that ``rfm-client compare --json`` uses. Raises RewardError.

    ``first`` and ``second`` are the videos' indices.
    """
    trajectories = [video.trajectory for video in asked.videos]
    preferred = partial(client.preference, subsample=True, resize=asked.question.resize, request_id=asked.request_id)
    results: dict[tuple[int, int], PreferenceResult] = {}
    try:
        for couple in itertools.combinations(range(len(trajectories)), 2):  # few videos on the way at a time
            orders = (couple, couple[::-1])
            answers = await asyncio.gather(*(preferred(*map(trajectories.__getitem__, order)) for order in orders))
            results |= zip(orders, answers, strict=True)
    except InvalidSampleError as error:
        raise invalid((error.where,), error.problem) from None
    ranking = Ranking(results=results)
    return {
        "model_version": ranking.model_version,
        "videos": [{"wins": wins, "rank": rank} for wins, rank in zip(ranking.wins, ranking.ranks, strict=True)],
        **ranking.document(ranking.numbers),
    }


def _event(name: str, **document: Any) -> str:
    return f"event: {name}\ndata: {to_json(document, inf_nan_mode='null').decode()}\n\n"  # JSON has no NaN


def _remedies(config: GatewayConfig, started_by: str) -> dict[str, str | bool]:
    """Return a command line for each fault, with the options that the page was started with.

    start: the server has ended
    dataset: there is no dataset
    triton: Triton does not answer
    model: Triton serves no model
    starts_triton: True: ``start`` also starts Triton
    """
    url = shlex.quote(config.triton_url)
    port = str(config.address.port)
    is_beside = started_by == "rfm serve"
    start = (
        f"{started_by} ... --gateway-port {port}"  # nobody tells the page what else it was started with
        if is_beside
        else f"{started_by} --triton {url} --port {port}"
    )
    return {
        "start": start,
        "dataset": f"{start} {'--gateway-dataset' if is_beside else '--dataset'} {_DATASET}",
        "triton": f"rfm-client status --url {url}" if is_beside else f"rfm serve {_REPOSITORY}",
        "model": f"rfm export {_CHECKPOINT} --repository {_REPOSITORY}",
        "starts_triton": is_beside,
    }
