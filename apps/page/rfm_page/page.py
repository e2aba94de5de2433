# SPDX-License-Identifier: MIT
"""The page, as a gateway serves it: entry point ``rfm_gateway.page``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from fastapi import APIRouter, FastAPI

from rfm_client.options import ConfigError
from rfm_gateway.mounting import GatewayConfig, Surroundings, add_page
from rfm_page.dataset_routes import dataset_routes
from rfm_page.live import live_routes
from rfm_page.routes import viewer_routes

if TYPE_CHECKING:
    from rfm_page.shown import ShownDataset

_PACKAGE = Path(__file__).parent


def routes(surroundings: Surroundings) -> APIRouter:
    """Return the page's endpoints. Raises ConfigError for a dataset that cannot be shown."""
    config, router = surroundings.config, APIRouter()
    router.include_router(viewer_routes(surroundings))
    router.include_router(dataset_routes(shown_datasets(config), config.timeout_s, surroundings.max_decoded_bytes))
    router.include_router(live_routes(surroundings.limits))
    return router


def add_files(app: FastAPI) -> None:
    """Add the page at ``/``, and its files."""
    folders = {"uplot": _PACKAGE / "vendored" / "uplot", "examples": _PACKAGE / "examples"}
    add_page(app, "/", "/viewer", _PACKAGE / "static", **folders)


def check(config: GatewayConfig) -> None:
    """Raise ConfigError for a dataset that cannot be shown."""
    shown_datasets(config)


def shown_datasets(config: GatewayConfig) -> list[ShownDataset]:
    """Return the datasets that the page shows. Raises ConfigError for a folder without such a dataset."""
    if not config.dataset:
        return []
    try:
        from rfm_labels.datasets import is_hdf5
        from rfm_page.datasets import ShownLeRobot
        from rfm_page.hdf5_datasets import ShownHdf5
    except ModuleNotFoundError as error:
        expected = f"the package {error.name}, which reads it"
        raise ConfigError.at("dataset", expected, "none: pip install ./apps/labels") from None
    return [ShownHdf5.open(path) if is_hdf5(Path(path)) else ShownLeRobot.open(path) for path in config.dataset]
