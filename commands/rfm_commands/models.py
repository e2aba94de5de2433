# SPDX-License-Identifier: MIT
"""``rfm models``: list and change the models and versions that a running server serves.

NAME is the name given to ``rfm export --name``, and means all models for the checkpoint. The commands use gRPC, because
a load over HTTP makes the server's other callers wait.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import typer

from rfm.serve.access import take_key
from rfm.serve.repository_api import RepositoryApi
from rfm_client.cli.command import CommandGroup, usage_errors, with_options
from rfm_client.cli.options import CredentialFiles
from rfm_client.contract.errors import InvalidValueError
from rfm_client.contract.settings import setting
from rfm_commands.command import RfmCommand
from rfm_commands.rollout import Rollout, check_files, models_of, previous_version

app = typer.Typer(cls=CommandGroup, no_args_is_help=True)


@dataclass(frozen=True)
class AdministeredServer(CredentialFiles):
    """A running server whose models are listed or change."""

    TITLE: ClassVar[str] = "Server"

    url: str = setting(
        "grpc://127.0.0.1:8001", "grpc://host:port of the server, with TLS grpcs://host:port.", variable="RFM_URL"
    )
    admin_key_file: Path | None = setting(None, "File with the server's admin key. Default: RFM_ADMIN_KEY.")

    @contextmanager
    def connected(self) -> Iterator[RepositoryApi]:
        """Yield the server's repository API. Raises InvalidValueError, RepositoryApiError."""
        options = self.credentials.grpc_options(self.url.partition(":")[0])
        key = take_key(self.admin_key_file, os.environ)
        with usage_errors("--url"):
            self.credentials.check_url(self.url)
            if len(self.url.split()) > 1:
                raise InvalidValueError(f"expected one server, got {self.url}")
            server = RepositoryApi(self.url, key, options, headers=self.credentials.shown)
        with server as api:
            yield api


@dataclass(frozen=True)
class AdministeredRepository(AdministeredServer):
    """A running server whose models change, and the repository that it reads."""

    repository: Path = setting(..., "The repository that the server reads.")


ExportedName = Annotated[str, typer.Argument(metavar="NAME", help="As in rfm export --name.")]


@app.callback()
def models() -> None:
    """List, load, unload and replace the models of a running server."""


@app.command("list", cls=RfmCommand)
@with_options
def list_models(server: AdministeredServer) -> None:
    """List the versions of each model, with state and reason.

    Example: rfm models list --admin-key-file admin.key
    """
    with server.connected() as api:
        index = api.index()
    rows = [(each.name, "" if each.version is None else str(each.version), each.state, each.reason) for each in index]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        typer.echo("  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip())


@app.command(cls=RfmCommand)
@with_options
def load(name: ExportedName, server: AdministeredRepository) -> None:
    """Serve NAME, a new or unloaded model, as configured.

    Example: rfm models load rfm --repository my_models
    """
    with server.connected() as api:
        models = models_of(server.repository, name)
        check_files(server.repository, dict.fromkeys(models))
        for model in models:
            typer.echo(f"{model}: loading")
            began_s = time.monotonic()
            api.load(model)
            ready = ", ".join(map(str, api.ready_versions(model)))
            typer.echo(f"{model}: {ready} ready after {time.monotonic() - began_s:.0f} s")


@app.command(cls=RfmCommand)
@with_options
def unload(name: ExportedName, server: AdministeredRepository) -> None:
    """Stop serving NAME after the answers to requests in flight. Its files stay.

    Example: rfm models unload rfm --repository my_models
    """
    with server.connected() as api:
        for model in reversed(models_of(server.repository, name)):
            api.unload(model)
            api.wait_gone(model)
            typer.echo(f"{model}: unloaded")


@app.command(cls=RfmCommand)
@with_options
def rollout(
    name: ExportedName,
    version: Annotated[int, typer.Argument(metavar="VERSION", help="The version folder to serve.")],
    server: AdministeredRepository,
) -> None:
    """Serve another version of NAME without losing a request.

    The new version is loaded beside the old version, probed, then served alone. If it fails, the old version stays.

    Example: rfm models rollout rfm 2 --repository my_models
    """
    with server.connected() as api:
        _roll_out(server, name, api, version)


@app.command(cls=RfmCommand)
@with_options
def rollback(name: ExportedName, server: AdministeredRepository) -> None:
    """Serve the previous version of NAME, as rollout does.

    Example: rfm models rollback rfm --repository my_models
    """
    with server.connected() as api:
        _roll_out(server, name, api, previous_version(server.repository, name, api))


def _roll_out(server: AdministeredRepository, name: str, api: RepositoryApi, version: int) -> None:
    api.check_api_key()  # which the probes need
    Rollout(server.repository, name, api, typer.echo).to(version)
    typer.echo(f"{name}: version {version} is served")
