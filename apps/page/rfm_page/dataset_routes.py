# SPDX-License-Identifier: MIT
"""The page's endpoints for datasets: episodes, an episode's curves, and its video from each camera.

A request names a dataset, an episode and a camera by number, and labels by a name from an earlier answer.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeVar

import anyio
from fastapi import APIRouter, HTTPException, Request, Response
from fastapi.responses import JSONResponse

from rfm_gateway.mounting import Decoded, while_connected
from rfm_labels import DatasetError

if TYPE_CHECKING:
    from rfm_page.shown import ShownDataset

Read = TypeVar("Read")

_HEADERS = {"Cache-Control": "no-cache", "X-Content-Type-Options": "nosniff"}


def dataset_routes(datasets: Sequence[ShownDataset], timeout_s: float, max_video_bytes: int) -> APIRouter:
    """Return the endpoints of the page's datasets. The evaluation server has no such endpoints."""
    router = APIRouter(include_in_schema=False)

    async def read(request: Request, number: int, reading: Callable[[ShownDataset], Read]) -> Read:
        """Check a dataset and read from it, in a thread, and return the result.

        Raises HTTPException 404 for a missing part, 500 for a broken dataset, 504 if reading takes too long.
        """
        if not 0 <= number < len(datasets):
            raise HTTPException(404, f"dataset: expected one of {len(datasets)}, got {number}")

        def checked(shown: ShownDataset) -> Read:
            shown.check()
            return reading(shown)

        try:
            with anyio.move_on_after(timeout_s):
                return await while_connected(request, asyncio.to_thread(checked, datasets[number]))
        except DatasetError as error:
            raise HTTPException(500, datasets[number].without_folder(str(error))) from None
        raise HTTPException(504, f"dataset: expected an answer within {timeout_s:g} s, got none")

    @router.get("/viewer/datasets")
    async def names() -> Response:
        about = await asyncio.to_thread(lambda: [each.about for each in datasets])
        return JSONResponse({"datasets": about})

    @router.get("/viewer/datasets/{dataset}")
    async def table(request: Request, dataset: int, labels: str | None = None) -> Response:
        return JSONResponse(await read(request, dataset, lambda shown: shown.table(labels)))

    @router.get("/viewer/datasets/{dataset}/faults")
    async def faults(request: Request, dataset: int) -> Response:
        return JSONResponse(await read(request, dataset, lambda shown: shown.faults()))

    @router.get("/viewer/datasets/{dataset}/episodes/{episode}")
    async def curves(request: Request, dataset: int, episode: int, labels: str | None = None) -> Response:
        return JSONResponse(await read(request, dataset, lambda shown: shown.curves(episode, labels)))

    @router.get("/viewer/datasets/{dataset}/episodes/{episode}/videos/{camera}")
    async def video(request: Request, dataset: int, episode: int, camera: int) -> Response:
        taken = Decoded(max_video_bytes)
        try:
            clip = await read(request, dataset, lambda shown: shown.video(episode, camera, taken.take))
        finally:
            taken.end()
        return Response(clip, media_type="video/mp4", headers=_HEADERS)

    return router
