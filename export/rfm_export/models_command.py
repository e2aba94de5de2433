# SPDX-License-Identifier: MIT
"""``rfm models``: which models, and which versions of them, a running server serves.

NAME is that of ``rfm export --name``: it stands for all models of the checkpoint.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from rfm.server.admin_key import AdminKeyError, take_key
from rfm.server.repository_api import ModelVersion, RepositoryApi, RepositoryApiError
from rfm_export.errors import ExportError
from rfm_export.rollout import Rollout, models_of, previous_version

DEFAULT_URL = "http://127.0.0.1:8000"
EXIT_FAILED = 1

app = typer.Typer(no_args_is_help=True)

AdminKeyFile = Annotated[
    Path | None,
    typer.Option(help="File with the server's admin key; else RFM_ADMIN_KEY.", show_default=False),
]
Name = Annotated[str, typer.Argument(help="As in rfm export --name.")]
Repository = Annotated[Path, typer.Option(help="The repository that the server reads.")]
Url = Annotated[str, typer.Option(help="The server, over HTTP.")]


@app.callback()
def models() -> None:
    """List, load and unload the models of a running server; serve another version of them without losing a request."""


@app.command("list")
def list_models(url: Url = DEFAULT_URL, admin_key_file: AdminKeyFile = None) -> None:
    """Each version of each model, its state, and why it is not ready."""
    with _server(url, admin_key_file) as server:
        rows = [_row(entry) for entry in server.index()]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        typer.echo("  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip())


@app.command()
def load(name: Name, repository: Repository, url: Url = DEFAULT_URL, admin_key_file: AdminKeyFile = None) -> None:
    """Serve what the configurations of NAME say: a new name, or one that was unloaded."""
    with _server(url, admin_key_file) as server:
        for model in models_of(repository, name):
            server.load(model)
            typer.echo(f"{model}: {', '.join(map(str, server.ready_versions(model)))} ready")


@app.command()
def unload(name: Name, repository: Repository, url: Url = DEFAULT_URL, admin_key_file: AdminKeyFile = None) -> None:
    """Serve NAME no more, once the requests in flight are answered. Its files stay."""
    with _server(url, admin_key_file) as server:
        for model in reversed(models_of(repository, name)):
            server.unload(model)
            server.wait_gone(model)
            typer.echo(f"{model}: unloaded")


@app.command()
def rollout(
    name: Name,
    version: Annotated[int, typer.Argument(min=1, help="The version folder to serve.")],
    repository: Repository,
    url: Url = DEFAULT_URL,
    admin_key_file: AdminKeyFile = None,
) -> None:
    """Serve another version of NAME: loaded beside the old one, probed, then alone. If it fails the old one stays."""
    with _server(url, admin_key_file) as server:
        Rollout(repository, name, server, typer.echo).to(version)
        typer.echo(f"{name}: version {version} is served")


@app.command()
def rollback(name: Name, repository: Repository, url: Url = DEFAULT_URL, admin_key_file: AdminKeyFile = None) -> None:
    """Serve the version before the one that is served, as rollout does."""
    with _server(url, admin_key_file) as server:
        version = previous_version(repository, name, server)
        Rollout(repository, name, server, typer.echo).to(version)
        typer.echo(f"{name}: version {version} is served")


@contextmanager
def _server(url: str, admin_key_file: Path | None) -> Iterator[RepositoryApi]:
    """The server; what goes wrong with it ends the command with one line."""
    try:
        with RepositoryApi(url, take_key(admin_key_file, os.environ)) as server:
            yield server
    except (AdminKeyError, RepositoryApiError, ExportError, OSError) as error:
        typer.echo(f"rfm: {error}", err=True)
        raise typer.Exit(EXIT_FAILED) from None


def _row(entry: ModelVersion) -> tuple[str, ...]:
    return entry.name, "" if entry.version is None else str(entry.version), entry.state, entry.reason
