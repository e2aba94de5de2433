# SPDX-License-Identifier: MIT
"""Find the page in the browser, which another package brings: an entry point of the group ``rfm_gateway.page``."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Protocol

from rfm_client.options import ConfigError

if TYPE_CHECKING:
    from fastapi import APIRouter, FastAPI

INSTALL = "pip install ./client ./apps/gateway ./apps/page"


class Page(Protocol):
    """What a package with a page defines."""

    def check(self, config: Any) -> None:
        """Raise ConfigError for settings of a GatewayConfig with which the page cannot be served."""

    def routes(self, surroundings: Any) -> APIRouter:
        """Return the endpoints, from ``rfm_gateway.mounting.Surroundings``. Raises ConfigError."""

    def add_files(self, app: FastAPI) -> None:
        """Add the page at ``/``, and its files."""


def page_of(config: Any) -> Page | None:
    """Return the page that a gateway with this GatewayConfig serves; None: it serves none.

    Raises ConfigError if it should show a dataset, but no page is installed.
    """
    found = list(entry_points(group="rfm_gateway.page")) if config.viewer else []
    if config.viewer and config.dataset and not found:
        raise ConfigError.at("dataset", "the package rfm-page, which shows it", f"none: {INSTALL}")
    page: Page | None = found[0].load() if found else None
    return page
