# SPDX-License-Identifier: MIT
"""The files of the page and of the documentation of endpoints. All come with the gateway, so neither needs a network.

A request names one of the files below or none: no path of a request is ever opened.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from fastapi import APIRouter, Request, Response

_PACKAGE = Path(__file__).parents[1]
_VENDORED = _PACKAGE / "vendored"
_MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}
_POLICY = (  # where the page may take from what; no script and no style of its own text, nothing of elsewhere
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; media-src 'self' blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",  # asked for again, and answered with 304 as long as it is the same
}
_VIEWER_FOLDERS = {"/viewer": _PACKAGE / "viewer" / "static", "/viewer/uplot": _VENDORED / "uplot"}
_DOCS_FOLDERS = {"/docs": _PACKAGE / "docs", "/docs/swagger-ui": _VENDORED / "swagger-ui"}


@dataclass(frozen=True)
class StaticFile:
    """A file in memory, as it is answered."""

    content: bytes
    media_type: str
    tag: str

    @classmethod
    def read(cls, file: Path) -> StaticFile:
        """The file as it is on the disk now."""
        content = file.read_bytes()
        return cls(content, _MEDIA_TYPES[file.suffix], f'"{hashlib.sha256(content).hexdigest()[:16]}"')

    def answer(self, request: Request) -> Response:
        """The file; nothing but 304 to a browser that has it."""
        headers = {**HEADERS, "ETag": self.tag}
        if request.headers.get("if-none-match") == self.tag:
            return Response(status_code=304, headers=headers)
        return Response(self.content, media_type=self.media_type, headers=headers)


def viewer_files() -> APIRouter:
    """The page at ``/``, and its parts."""
    return _served(_VIEWER_FOLDERS, {"/": _VIEWER_FOLDERS["/viewer"] / "index.html"})


def docs_files() -> APIRouter:
    """Swagger UI at ``/docs``, and its parts."""
    return _served(_DOCS_FOLDERS, {"/docs": _DOCS_FOLDERS["/docs"] / "index.html"})


def _served(folders: dict[str, Path], pages: dict[str, Path]) -> APIRouter:
    """A route for each file of the folders that a browser can show, and for each page."""
    files = {
        f"{path}/{file.name}": file
        for path, folder in folders.items()
        for file in sorted(folder.iterdir())
        if file.suffix in _MEDIA_TYPES and file.suffix != ".html"
    }
    router = APIRouter(include_in_schema=False)
    for path, file in {**files, **pages}.items():
        router.add_api_route(path, StaticFile.read(file).answer, methods=["GET", "HEAD"])
    return router
