# SPDX-License-Identifier: MIT
"""What the page asks of datasets: their episodes, an episode's curves, and its video as each camera filmed it.

A request names a dataset, an episode and a camera by number, and labels by one of the names that it was told.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import anyio
from fastapi import APIRouter, HTTPException, Request, Response
from fastapi.responses import FileResponse, JSONResponse
from starlette.types import Receive, Scope, Send

from rfm_client.data.datasets.protocol import DatasetError
from rfm_gateway.body import BodyLimits
from rfm_gateway.cancellation import while_connected
from rfm_gateway.viewer.cuts import MEDIA_TYPE, cut
from rfm_gateway.viewer.datasets import ShownDataset, UnknownError

T = TypeVar("T")

_HEADERS = {"Cache-Control": "no-cache", "X-Content-Type-Options": "nosniff"}


@dataclass(frozen=True)
class Shelf:
    """The datasets of a page, and what reading them is limited by. timeout_s: within which an answer is ready"""

    datasets: Sequence[ShownDataset]
    limits: BodyLimits
    timeout_s: float

    async def read(self, request: Request, number: int, read: Callable[[ShownDataset], T]) -> T:
        """What ``read`` gives of a dataset, in a thread. Raises HTTPException: 404 for what is not there, 500 for a
        broken dataset, 504 if it takes too long.
        """
        with _answered(self.datasets, number) as dataset:
            with anyio.move_on_after(self.timeout_s):
                return await while_connected(request, asyncio.to_thread(read, dataset))
            raise HTTPException(504, f"dataset: expected an answer within {self.timeout_s:g} s, got none")


def dataset_routes(shelf: Shelf) -> APIRouter:
    """The endpoints of the page's datasets. They are its own, and not those of the evaluation server."""
    router = APIRouter(include_in_schema=False)

    @router.get("/viewer/datasets")
    async def datasets() -> Response:
        about = await asyncio.to_thread(lambda: [each.about for each in shelf.datasets])
        return JSONResponse({"datasets": about})

    @router.get("/viewer/datasets/{dataset}")
    async def table(request: Request, dataset: int, labels: str | None = None) -> Response:
        return JSONResponse(await shelf.read(request, dataset, lambda shown: shown.table(labels)))

    @router.get("/viewer/datasets/{dataset}/episodes/{episode}")
    async def curves(request: Request, dataset: int, episode: int, labels: str | None = None) -> Response:
        return JSONResponse(await shelf.read(request, dataset, lambda shown: shown.curves(episode, labels)))

    @router.get("/viewer/datasets/{dataset}/episodes/{episode}/videos/{camera}")
    async def video(request: Request, dataset: int, episode: int, camera: int) -> Response:
        with ExitStack() as stack:
            admitted = stack.enter_context(shelf.limits.admitted(request))
            folder = TemporaryDirectory(prefix="rfm-gateway-", ignore_cleanup_errors=True)  # a late thread may write
            file = Path(stack.enter_context(folder)) / "video.mp4"
            await shelf.read(
                request, dataset, lambda shown: cut(shown.span(episode, camera), file, admitted.share.take)
            )
            return _Cut(file, stack.pop_all())

    return router


@contextmanager
def _answered(datasets: Sequence[ShownDataset], number: int) -> Iterator[ShownDataset]:
    """The dataset of a number. What goes wrong with it becomes an answer."""
    if not 0 <= number < len(datasets):
        raise HTTPException(404, f"dataset: expected one of {len(datasets)}, got {number}")
    try:
        yield datasets[number]
    except UnknownError as error:
        raise HTTPException(404, str(error)) from None
    except DatasetError as error:
        raise HTTPException(500, datasets[number].without_folder(str(error))) from None


class _Cut(FileResponse):
    """A file that is there as long as ``held``, which ends with the answer, also if nobody reads it."""

    def __init__(self, file: Path, held: ExitStack) -> None:
        super().__init__(file, media_type=MEDIA_TYPE, headers=_HEADERS)
        self._held = held

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Sends the file, or the ranges of it that are asked for."""
        with self._held:
            await super().__call__(scope, receive, send)
