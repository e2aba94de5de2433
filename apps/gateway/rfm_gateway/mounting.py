# SPDX-License-Identifier: MIT
"""Browser pages: Swagger UI, and the page that another package brings.

The page files are installed, so they need no network. The other package's entry point in the group
``rfm_gateway.page`` names an ``AddPage``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeAlias

from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.params import Depends
from starlette.staticfiles import StaticFiles

from rfm_client.options import ConfigError
from rfm_gateway.body import BodyLimits
from rfm_gateway.config import GatewayConfig
from rfm_gateway.field_errors import field_errors, invalid
from rfm_gateway.form import Upload
from rfm_gateway.observe import GatewayMetrics, while_connected

__all__ = ["BodyLimits", "GatewayConfig", "PageHost", "Upload", "field_errors", "invalid", "while_connected"]

INSTALL = "pip install ./client ./apps/gateway ./apps/page"
_PACKAGE = Path(__file__).parent
_POLICY = (  # nothing from other hosts, no inline scripts or styles
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; media-src 'self' blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",  # browsers ask again, and get 304 for an unchanged file
}


class _Files(StaticFiles):
    """Serves the files in a folder, with a page's headers."""

    def file_response(self, *arguments: Any, **options: Any) -> Response:
        response = super().file_response(*arguments, **options)
        response.headers.update(_HEADERS)
        return response


def add_docs(app: FastAPI) -> None:
    """Add Swagger UI and its files at ``/docs``."""
    _add_files(app, "/docs", "/docs", _PACKAGE / "docs", **{"swagger-ui": _PACKAGE / "vendored" / "swagger-ui"})


def _add_files(app: FastAPI, page: str, path: str, folder: Path, **folders: Path) -> None:
    """Add a page whose ``index.html`` is in ``folder``.

    page: path where the page is served
    path: path where its files are served
    folders: more of its files, by the name below ``path``
    """
    files = _Files(directory=folder)

    @app.api_route(page, methods=["GET", "HEAD"], include_in_schema=False)
    async def index(request: Request) -> Response:
        return await files.get_response("index.html", request.scope)

    for name, each in folders.items():
        app.mount(f"{path}/{name}", _Files(directory=each))
    app.mount(path, files)


@dataclass(frozen=True)
class PageHost:
    """The gateway that serves a page.

    guards: refuse requests without the gateway's key
    place: for endpoints that score: waits until another evaluation may run
    started_by: the command that a person repeats to restart the gateway: ``rfm serve`` or a gateway command
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
        """Serve ``index.html`` at ``/`` and the files in ``folder`` at ``/viewer``, after the endpoints, without a key.

        folders: more files, by the name below ``/viewer``
        """
        _add_files(self.app, "/", "/viewer", folder, **folders)


AddPage: TypeAlias = Callable[[PageHost], None]  # adds a page; raises ConfigError for settings that it cannot serve


def page_of(config: GatewayConfig) -> AddPage | None:
    """Return the function that adds the page; None: the gateway serves none.

    Raises ConfigError if it should show a dataset, but no page is installed.
    """
    found = list(entry_points(group="rfm_gateway.page")) if config.viewer else []
    if config.viewer and config.dataset and not found:
        raise ConfigError.at("dataset", "the package rfm-page, which shows it", f"none: {INSTALL}")
    page: AddPage | None = found[0].load() if found else None
    return page
