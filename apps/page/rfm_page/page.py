# SPDX-License-Identifier: MIT
"""Add the page to the gateway that serves it: entry point ``rfm_gateway.page``.

A request about a dataset names the dataset, episode and camera by number, and labels by a name from an earlier
response.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import anyio
from fastapi import APIRouter, HTTPException, Request, Response
from pydantic_core import to_json

from rfm_client.options import ConfigError
from rfm_gateway.mounting import BodyLimits, GatewayConfig, PageHost, while_connected
from rfm_page.routes import viewer_routes

if TYPE_CHECKING:
    from rfm_page.shown import ShownDataset

Read = TypeVar("Read")

_PACKAGE = Path(__file__).parent
_HEADERS = {"Cache-Control": "no-cache", "X-Content-Type-Options": "nosniff"}


def add_page(host: PageHost) -> None:
    """Add the page's endpoints and files to a gateway. Raises ConfigError for a dataset that cannot be shown."""
    host.add_endpoints(viewer_routes(host))
    host.add_endpoints(dataset_routes(shown_datasets(host.config), host.limits))
    folders = {"uplot": _PACKAGE / "vendored" / "uplot", "examples": _PACKAGE / "examples"}
    host.add_files(_PACKAGE / "static", **folders)


def shown_datasets(config: GatewayConfig) -> list[ShownDataset]:
    """Return the datasets that the page shows. Raises ConfigError for a folder without a dataset that it can show."""
    if not config.dataset:
        return []
    try:
        import pyarrow  # noqa: F401

        from rfm_labels import DatasetError
        from rfm_labels.datasets import Hdf5Dataset, LeRobotDataset, open_to_show
        from rfm_page.datasets import ShownHdf5, ShownLeRobot
        from rfm_page.shown import ShownDataset
    except ImportError as error:
        raise ConfigError.at(
            "dataset", "packages that read it", f"{error}: pip install ./client ./apps/labels"
        ) from None
    datasets: list[ShownDataset] = []
    try:
        for dataset in chain.from_iterable(map(open_to_show, config.dataset)):
            if isinstance(dataset, LeRobotDataset):
                datasets.append(ShownLeRobot(dataset))
            elif isinstance(dataset, Hdf5Dataset):
                datasets.append(ShownHdf5(dataset))
            else:
                datasets.append(ShownDataset(dataset))
            datasets[-1].check()
    except (DatasetError, ImportError) as error:
        raise ConfigError(str(error), "dataset") from None
    return datasets


def dataset_routes(datasets: Sequence[ShownDataset], limits: BodyLimits) -> APIRouter:
    """Return the endpoints for the page's datasets. The evaluation server has no such endpoints."""
    router = APIRouter(include_in_schema=False)
    downloading = asyncio.Lock()

    def numbered(number: int) -> ShownDataset:
        if not 0 <= number < len(datasets):
            raise HTTPException(404, f"dataset: expected one of {len(datasets)}, got {number}")
        return datasets[number]

    async def read(request: Request, number: int, reading: Callable[[ShownDataset], Read]) -> Read:
        """Check a dataset and read from it, in a thread, and return the result.

        Raises HTTPException 404 for a missing part, 500 for a broken dataset, 504 if reading takes too long.
        """
        with anyio.move_on_after(limits.timeout_s):
            return await while_connected(request, asyncio.to_thread(numbered(number).read, reading))
        raise HTTPException(504, f"dataset: expected an answer within {limits.timeout_s:g} s, got none")

    async def downloaded(dataset: ShownDataset, episode: int) -> dict[str, Any]:
        """Download what an episode lacks, after other downloads. The thread goes on if the caller leaves."""
        await downloading.acquire()
        thread = asyncio.create_task(asyncio.to_thread(dataset.read, lambda shown: shown.download(episode)))
        thread.add_done_callback(lambda _: downloading.release())
        return await asyncio.shield(thread)

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

    @router.get("/viewer/datasets/{dataset}/episodes/{episode}/missing")
    async def missing(request: Request, dataset: int, episode: int) -> Response:
        return _json(await read(request, dataset, lambda shown: shown.missing(episode)))

    @router.post("/viewer/datasets/{dataset}/episodes/{episode}/missing")
    async def download(request: Request, dataset: int, episode: int) -> Response:
        return _json(await while_connected(request, downloaded(numbered(dataset), episode)))

    @router.get("/viewer/datasets/{dataset}/episodes/{episode}/preview")
    async def preview(request: Request, dataset: int, episode: int, labels: str | None = None) -> Response:
        with limits.decoding() as take:
            return _json(await read(request, dataset, lambda shown: shown.preview(episode, labels, take)))

    @router.get("/viewer/datasets/{dataset}/episodes/{episode}/videos/{camera}")
    async def video(request: Request, dataset: int, episode: int, camera: int) -> Response:
        with limits.decoding() as take:
            clip, is_stored = await read(request, dataset, lambda shown: shown.video(episode, camera, take))
        frames = {"X-Frames": "stored" if is_stored else "encoded"}
        return Response(clip, media_type="video/mp4", headers={**_HEADERS, **frames})

    return router


def _json(document: dict[str, Any]) -> Response:
    """Return a JSON response, with null for NaN, which JSON does not have."""
    return Response(to_json(document, inf_nan_mode="null"), media_type="application/json")
