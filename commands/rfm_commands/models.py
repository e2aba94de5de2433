# SPDX-License-Identifier: MIT
"""``rfm models``: list and change the models and versions that a running server serves.

NAME is that of ``rfm export --name``, and means all models of the checkpoint. The commands use gRPC, because a load
over HTTP makes the server's other callers wait.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, TypeAlias

import typer

from rfm.launch.admin_key import take_key
from rfm.launch.repository_api import ModelVersion, RepositoryApi, RepositoryApiError
from rfm_client.cli.command import Given, OptionsOf, with_options
from rfm_client.cli.options import CredentialFiles
from rfm_client.contract.settings import Settings, setting
from rfm_commands.command import RfmCommand
from rfm_commands.rollout import Rollout, check_files, models_of, previous_version

SECURE = "grpcs://"

app = typer.Typer(no_args_is_help=True)


@dataclass(frozen=True)
class AdministeredServer(Settings):
    """A running server whose models change, and its repository."""

    TITLE: ClassVar[str] = "Server"

    repository: Path = setting(Path(), "The repository that the server reads.")
    url: str = setting("grpc://127.0.0.1:8001", "grpc://host:port of the server, with TLS grpcs://host:port.")
    admin_key_file: Path | None = setting(None, "File with the server's admin key; else RFM_ADMIN_KEY.")

    @contextmanager
    def connected(self, context: typer.Context, files: Given) -> Iterator[RepositoryApi]:
        """Yield the server's repository API. Raises InvalidValueError, RepositoryApiError.

        files: given after the subcommand; they win over those before it
        """
        before: CredentialFiles = context.obj
        credentials = replace(before, **files).read()
        if credentials.uses_tls and not self.url.startswith(SECURE):
            raise RepositoryApiError.at("url", f"{SECURE}host:port with certificates", self.url)
        options = credentials.grpc_options(self.url.partition(":")[0])
        with RepositoryApi(self.url, take_key(self.admin_key_file, os.environ), options) as api:
            yield api


OF_TLS = ("ca_file", "client_certificate", "client_key")
FilesGiven: TypeAlias = Annotated[Given, OptionsOf(CredentialFiles, only=OF_TLS, title="TLS", reads_variables=False)]
ExportedName = Annotated[str, typer.Argument(help="As in rfm export --name.")]
Administered: TypeAlias = Annotated[AdministeredServer, OptionsOf(AdministeredServer, required=("repository",))]


@app.callback()
@with_options
def models(
    context: typer.Context,
    files: Annotated[CredentialFiles, OptionsOf(CredentialFiles, only=OF_TLS)],
) -> None:
    """List, load, unload and replace the models of a running server."""
    context.obj = files


@app.command("list", cls=RfmCommand)
@with_options
def list_models(
    context: typer.Context,
    server: Annotated[AdministeredServer, OptionsOf(AdministeredServer, only=("url", "admin_key_file"))],
    files: FilesGiven,
) -> None:
    """List the versions of each model, with state and reason."""
    with server.connected(context, files) as api:
        rows = [_row(entry) for entry in api.index()]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        typer.echo("  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip())


@app.command(cls=RfmCommand)
@with_options
def load(context: typer.Context, name: ExportedName, server: Administered, files: FilesGiven) -> None:
    """Serve NAME, a new or unloaded model, as configured."""
    with server.connected(context, files) as api:
        models = models_of(server.repository, name)
        check_files(server.repository, dict.fromkeys(models))
        for model in models:
            api.load(model)
            typer.echo(f"{model}: {', '.join(map(str, api.ready_versions(model)))} ready")


@app.command(cls=RfmCommand)
@with_options
def unload(context: typer.Context, name: ExportedName, server: Administered, files: FilesGiven) -> None:
    """Stop serving NAME after the answers to requests in flight. Its files stay."""
    with server.connected(context, files) as api:
        for model in reversed(models_of(server.repository, name)):
            api.unload(model)
            api.wait_gone(model)
            typer.echo(f"{model}: unloaded")


@app.command(cls=RfmCommand)
@with_options
def rollout(
    context: typer.Context,
    name: ExportedName,
    version: Annotated[int, typer.Argument(help="The version folder to serve.")],
    server: Administered,
    files: FilesGiven,
) -> None:
    """Serve another version of NAME without losing a request.

    The new version is loaded beside the old version, probed, then served alone. If it fails, the old version stays.
    """
    with server.connected(context, files) as api:
        _roll_out(server, name, api, version)


@app.command(cls=RfmCommand)
@with_options
def rollback(context: typer.Context, name: ExportedName, server: Administered, files: FilesGiven) -> None:
    """Serve the previous version of NAME, as rollout does."""
    with server.connected(context, files) as api:
        _roll_out(server, name, api, previous_version(server.repository, name, api))


def _roll_out(server: AdministeredServer, name: str, api: RepositoryApi, version: int) -> None:
    Rollout(server.repository, name, api, typer.echo).to(version)
    typer.echo(f"{name}: version {version} is served")


def _row(entry: ModelVersion) -> tuple[str, ...]:
    return entry.name, "" if entry.version is None else str(entry.version), entry.state, entry.reason
