# SPDX-License-Identifier: MIT
"""``rfm models``: which models, and which versions of them, a running server serves.

NAME is that of ``rfm export --name``: it stands for all models of the checkpoint. The server is reached over gRPC: a
load over HTTP would keep its other callers waiting.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from rfm.launch.admin_key import take_key
from rfm.launch.repository_api import ModelVersion, RepositoryApi, RepositoryApiError
from rfm_client.cli.command import OptionsOf, with_options
from rfm_client.cli.options import AccessFiles
from rfm_client.transport.access import Access
from rfm_commands.command import AdminKeyFile, RfmCommand, fail
from rfm_commands.rollout import Rollout, models_of, previous_version

DEFAULT_URL = "grpc://127.0.0.1:8001"
SECURE = "grpcs://"

app = typer.Typer(no_args_is_help=True)

Name = Annotated[str, typer.Argument(help="As in rfm export --name.")]
Repository = Annotated[Path, typer.Option(help="The repository that the server reads.")]
Url = Annotated[str, typer.Option(help="grpc://host:port of the server, with TLS grpcs://host:port.")]


@app.callback()
@with_options
def models(
    context: typer.Context,
    files: Annotated[AccessFiles, OptionsOf(AccessFiles, only=("ca_file", "client_certificate", "client_key"))],
) -> None:
    """List, load, unload and replace the models of a running server."""
    try:
        context.obj = files.read()
    except ValueError as error:
        fail(str(error))


@app.command("list", cls=RfmCommand)
def list_models(context: typer.Context, url: Url = DEFAULT_URL, admin_key_file: AdminKeyFile = None) -> None:
    """Each version of each model, its state, and why it is not ready."""
    with _server(context, url, admin_key_file) as server:
        rows = [_row(entry) for entry in server.index()]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        typer.echo("  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip())


@app.command(cls=RfmCommand)
def load(
    context: typer.Context,
    name: Name,
    repository: Repository,
    url: Url = DEFAULT_URL,
    admin_key_file: AdminKeyFile = None,
) -> None:
    """Serve NAME as its configurations say. It is new, or was unloaded."""
    with _server(context, url, admin_key_file) as server:
        for model in models_of(repository, name):
            server.load(model)
            typer.echo(f"{model}: {', '.join(map(str, server.ready_versions(model)))} ready")


@app.command(cls=RfmCommand)
def unload(
    context: typer.Context,
    name: Name,
    repository: Repository,
    url: Url = DEFAULT_URL,
    admin_key_file: AdminKeyFile = None,
) -> None:
    """Stop serving NAME when the requests in flight are answered. Its files stay."""
    with _server(context, url, admin_key_file) as server:
        for model in reversed(models_of(repository, name)):
            server.unload(model)
            server.wait_gone(model)
            typer.echo(f"{model}: unloaded")


@app.command(cls=RfmCommand)
def rollout(
    context: typer.Context,
    name: Name,
    version: Annotated[int, typer.Argument(min=1, help="The version folder to serve.")],
    repository: Repository,
    url: Url = DEFAULT_URL,
    admin_key_file: AdminKeyFile = None,
) -> None:
    """Serve another version of NAME without losing a request.

    It is loaded beside the old one, probed, then alone. If it fails the old one stays.
    """
    with _server(context, url, admin_key_file) as server:
        Rollout(repository, name, server, typer.echo).to(version)
        typer.echo(f"{name}: version {version} is served")


@app.command(cls=RfmCommand)
def rollback(
    context: typer.Context,
    name: Name,
    repository: Repository,
    url: Url = DEFAULT_URL,
    admin_key_file: AdminKeyFile = None,
) -> None:
    """Serve the version before this one, as rollout does."""
    with _server(context, url, admin_key_file) as server:
        version = previous_version(repository, name, server)
        Rollout(repository, name, server, typer.echo).to(version)
        typer.echo(f"{name}: version {version} is served")


@contextmanager
def _server(context: typer.Context, url: str, admin_key_file: Path | None) -> Iterator[RepositoryApi]:
    access: Access = context.obj
    if access.uses_tls and not url.startswith(SECURE):
        raise RepositoryApiError(f"url: expected {SECURE}host:port with certificates, got {url}")
    options = access.grpc_options(url.partition(":")[0])
    with RepositoryApi(url, take_key(admin_key_file, os.environ), options) as server:
        yield server


def _row(entry: ModelVersion) -> tuple[str, ...]:
    return entry.name, "" if entry.version is None else str(entry.version), entry.state, entry.reason
