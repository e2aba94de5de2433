# SPDX-License-Identifier: MIT
"""Serve the files of pages, such as Swagger UI. They are installed, so they need no network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request, Response
from starlette.staticfiles import StaticFiles

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
    """The files of a folder, with the headers of a page."""

    def file_response(self, *arguments: Any, **options: Any) -> Response:
        response = super().file_response(*arguments, **options)
        response.headers.update(_HEADERS)
        return response


def add_docs(app: FastAPI) -> None:
    """Add Swagger UI at ``/docs``, and its files."""
    add_page(app, "/docs", "/docs", _PACKAGE / "docs", **{"swagger-ui": _PACKAGE / "vendored" / "swagger-ui"})


def add_page(app: FastAPI, page: str, path: str, folder: Path, **folders: Path) -> None:
    """Add a page whose ``index.html`` is in ``folder``.

    page: path of the page
    path: of its files
    folders: more of its files, by the name below ``path``
    """
    files = _Files(directory=folder)

    @app.api_route(page, methods=["GET", "HEAD"], include_in_schema=False)
    async def index(request: Request) -> Response:
        return await files.get_response("index.html", request.scope)

    for name, each in folders.items():
        app.mount(f"{path}/{name}", _Files(directory=each))
    app.mount(path, files)
