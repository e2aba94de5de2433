# SPDX-License-Identifier: MIT
"""The page in the browser, which another package brings: how the gateway finds it, and what it offers to it.

The package's entry point in the group ``rfm_gateway.page`` names an ``AddPage``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import TypeAlias

from fastapi import APIRouter, FastAPI
from fastapi.params import Depends

from rfm_client.options import ConfigError
from rfm_gateway.body import BodyLimits
from rfm_gateway.config import GatewayConfig
from rfm_gateway.field_errors import field_errors, invalid
from rfm_gateway.observe import GatewayMetrics, while_connected
from rfm_gateway.pages import add_page

__all__ = ["BodyLimits", "GatewayConfig", "PageHost", "field_errors", "invalid", "while_connected"]

INSTALL = "pip install ./client ./apps/gateway ./apps/page"


@dataclass(frozen=True)
class PageHost:
    """The gateway that serves a page.

    guards: refuse requests without the gateway's key
    place: of endpoints that score: waits for a place among the evaluations at a time
    started_by: the command that a person repeats to start the gateway again: ``rfm serve`` or one of its own
    """

    app: FastAPI
    guards: Sequence[Depends]
    place: Depends
    config: GatewayConfig
    limits: BodyLimits
    metrics: GatewayMetrics
    started_by: str

    def add_endpoints(self, router: APIRouter) -> None:
        """Serve endpoints to callers with the gateway's key."""
        self.app.include_router(router, dependencies=self.guards)

    def add_files(self, folder: Path, **folders: Path) -> None:
        """Serve ``index.html`` at ``/`` and the files of ``folder`` at ``/viewer``, after its endpoints, without a key.

        folders: more files, by the name below ``/viewer``
        """
        add_page(self.app, "/", "/viewer", folder, **folders)


AddPage: TypeAlias = Callable[[PageHost], None]  # adds a page; raises ConfigError for settings that it cannot serve


def page_of(config: GatewayConfig) -> AddPage | None:
    """Return what adds the page; None: the gateway serves none.

    Raises ConfigError if it should show a dataset, but no page is installed.
    """
    found = list(entry_points(group="rfm_gateway.page")) if config.viewer else []
    if config.viewer and config.dataset and not found:
        raise ConfigError.at("dataset", "the package rfm-page, which shows it", f"none: {INSTALL}")
    page: AddPage | None = found[0].load() if found else None
    return page
