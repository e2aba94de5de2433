# SPDX-License-Identifier: MIT
"""The page's endpoints for datasets: episodes, an episode's preview and curves, and its video from each camera.

A request names a dataset, an episode and a camera by number, and labels by a name from an earlier answer.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import anyio
from fastapi import APIRouter, HTTPException, Request, Response
from pydantic_core import to_json

from rfm_gateway.mounting import BodyLimits, while_connected

if TYPE_CHECKING:
    from rfm_page.shown import ShownDataset

Read = TypeVar("Read")

_HEADERS = {"Cache-Control": "no-cache", "X-Content-Type-Options": "nosniff"}


def dataset_routes(datasets: Sequence[ShownDataset], limits: BodyLimits) -> APIRouter:
    """Return the endpoints of the page's datasets. The evaluation server has no such endpoints."""
    router = APIRouter(include_in_schema=False)

    async def read(request: Request, number: int, reading: Callable[[ShownDataset], Read]) -> Read:
        """Check a dataset and read from it, in a thread, and return the result.

        Raises HTTPException 404 for a missing part, 500 for a broken dataset, 504 if reading takes too long.
        """
        if not 0 <= number < len(datasets):
            raise HTTPException(404, f"dataset: expected one of {len(datasets)}, got {number}")
        with anyio.move_on_after(limits.timeout_s):
            return await while_connected(request, asyncio.to_thread(datasets[number].read, reading))
        raise HTTPException(504, f"dataset: expected an answer within {limits.timeout_s:g} s, got none")

    @router.get("/viewer/datasets")
    async def names() -> Response:
        about = await asyncio.to_thread(lambda: [each.about for each in datasets])
        return _json({"datasets": about})

    @router.get("/viewer/datasets/{dataset}")
    async def table(request: Request, dataset: int, labels: str | None = None) -> Response:
        return _json(await read(request, dataset, lambda shown: shown.table(labels)))

    @router.get("/viewer/datasets/{dataset}/faults")
    async def faults(request: Request, dataset: int) -> Response:
        return _json(await read(request, dataset, lambda shown: shown.faults()))

    @router.get("/viewer/datasets/{dataset}/episodes/{episode}")
    async def curves(request: Request, dataset: int, episode: int, labels: str | None = None) -> Response:
        return _json(await read(request, dataset, lambda shown: shown.curves(episode, labels)))

    @router.get("/viewer/datasets/{dataset}/episodes/{episode}/preview")
    async def preview(request: Request, dataset: int, episode: int, labels: str | None = None) -> Response:
        with limits.decoding() as take:
            return _json(await read(request, dataset, lambda shown: shown.preview(episode, labels, take)))

    @router.get("/viewer/datasets/{dataset}/episodes/{episode}/videos/{camera}")
    async def video(request: Request, dataset: int, episode: int, camera: int) -> Response:
        with limits.decoding() as take:
            clip = await read(request, dataset, lambda shown: shown.video(episode, camera, take))
        return Response(clip, media_type="video/mp4", headers=_HEADERS)

    return router


def _json(document: dict[str, Any]) -> Response:
    """Return an answer in JSON, with null for NaN, which JSON does not have."""
    return Response(to_json(document, inf_nan_mode="null"), media_type="application/json")
