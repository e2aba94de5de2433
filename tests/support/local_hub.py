# SPDX-License-Identifier: MIT
"""A Hugging Face Hub on the loopback, for the real ``huggingface_hub`` (``HF_ENDPOINT``)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from unittest import mock
from urllib.parse import parse_qs, unquote

from servers import Quiet, web_server


def commit_of(revision: str) -> str:
    """Forty digits, as git names commits."""
    return hashlib.sha1(revision.encode()).hexdigest()


@contextmanager
def hub(
    repositories: Mapping[str, Mapping[str, Path]], kind: str = "models", parameters: Mapping[str, int] | None = None
) -> Iterator[str]:
    """Serve repositories by id (``org/name``) with a folder per revision. Yields the endpoint.

    kind: ``models`` or ``datasets``. All revisions but main are tags
    parameters: what the Hub says about weights, by their type
    """

    class Handler(Quiet, BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.path = self.path.partition("?")[0]
            place = "" if kind == "models" else f"/{kind}"
            words = self.path.removeprefix(f"/api/{kind}" if self.path.startswith("/api/") else place).split("/")
            repository = "/".join(words[1:3])
            if repository not in repositories:  # a question of newer clients to the Hub itself
                self._send(404, b"")
                return
            revisions = repositories[repository]
            folders = {**revisions, **{commit_of(name): folder for name, folder in revisions.items()}}
            api, files = f"/api/{kind}/{repository}", f"{place}/{repository}/resolve/"
            if self.path == f"{api}/refs":
                tags = [
                    {"name": name, "ref": f"refs/tags/{name}", "targetCommit": commit_of(name)}
                    for name in revisions
                    if name != "main"
                ]
                self._send(200, json.dumps({"branches": [], "converts": [], "tags": tags}).encode())
            elif self.path == api or self.path.startswith(f"{api}/revision/"):
                revision = self.path.removeprefix(f"{api}/revision/") if self.path != api else "main"
                if revision not in folders:
                    self._send(404, b"", {"X-Error-Code": "RevisionNotFound"})
                    return
                folder = folders[revision]
                named = {str(file.relative_to(folder)): file for file in sorted(folder.rglob("*")) if file.is_file()}
                siblings = [{"rfilename": name, "size": file.stat().st_size} for name, file in named.items()]
                told = {"id": repository, "sha": _commit(revisions, revision), "siblings": siblings}
                if parameters is not None:
                    told["safetensors"] = {"parameters": parameters, "total": sum(parameters.values())}
                self._send(200, json.dumps(told).encode())
            elif self.path.startswith(f"{api}/tree/"):
                revision = self.path.removeprefix(f"{api}/tree/")
                told = [_told(file, folders[revision]) for file in folders[revision].rglob("*") if file.is_file()]
                self._send(200, json.dumps(told).encode())
            else:
                revision, _, name = self.path.removeprefix(files).partition("/")
                file = folders[revision] / unquote(name)
                if not file.is_file():
                    of_commit = {"X-Repo-Commit": _commit(revisions, revision)}
                    self._send(404, b"", {"X-Error-Code": "EntryNotFound", **of_commit})
                    return
                content = file.read_bytes()
                etag = f'"{hashlib.sha1(content).hexdigest()}"'
                self._send(200, content, {"ETag": etag, "X-Repo-Commit": _commit(revisions, revision)})

        do_HEAD = do_GET  # noqa: N815  the name that http.server asks for

        def do_POST(self) -> None:
            """Answer a request for the sizes of named files, the only POST that is served."""
            asked = parse_qs(self.rfile.read(int(self.headers["Content-Length"])).decode())["paths"]
            repository, _, revision = self.path.removeprefix(f"/api/{kind}/").partition("/paths-info/")
            folder = next(each for name, each in repositories[repository].items() if commit_of(name) == revision)
            files = [file for name in asked if (file := folder / name).is_file()]
            self._send(200, json.dumps([_told(file, folder) for file in files]).encode())

        def _send(self, status: int, body: bytes, headers: Mapping[str, str] | None = None) -> None:
            self.send_response(status)
            for name, value in (headers or {}).items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body)

    with web_server(Handler) as url:
        yield url


@contextmanager
def asked(endpoint: str, cache: Path, timeout_s: int = 10) -> Iterator[None]:
    """Let this process ask the Hub at ``endpoint``, with an empty cache or one that another call filled.

    ``huggingface_hub`` reads the environment once, into these constants.
    """
    from huggingface_hub import constants, file_download
    from huggingface_hub.utils import _http

    template = endpoint + "/{repo_id}/resolve/{revision}/{filename}"
    is_copied = hasattr(file_download, "HUGGINGFACE_CO_URL_TEMPLATE")  # until huggingface_hub 1.33
    reader = file_download if is_copied else constants
    changed = {
        "ENDPOINT": endpoint,
        "HF_HUB_CACHE": str(cache),
        "HF_HUB_OFFLINE": False,
        "HF_HUB_ETAG_TIMEOUT": timeout_s,
    }
    forget = getattr(_http, "reset_sessions", lambda: None)  # sessions of huggingface_hub 0.x are offline for good
    forget()
    with (
        mock.patch.multiple(constants, **changed),
        mock.patch.object(reader, "HUGGINGFACE_CO_URL_TEMPLATE", template),
    ):
        yield
    forget()


def _told(file: Path, folder: Path) -> dict[str, object]:
    oid = hashlib.sha1(file.read_bytes()).hexdigest()
    return {"type": "file", "path": str(file.relative_to(folder)), "size": file.stat().st_size, "oid": oid}


def _commit(revisions: Mapping[str, Path], revision: str) -> str:
    """Return the commit of a revision or commit."""
    return commit_of(revision) if revision in revisions else revision
