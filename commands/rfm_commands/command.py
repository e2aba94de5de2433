# SPDX-License-Identifier: MIT
"""Shared parts of ``rfm``'s commands: options, errors on one line, lines for the user."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, ClassVar, NoReturn

import typer

from rfm_client.cli import command

AdminKeyFile = Annotated[
    Path | None, typer.Option(help="File with the server's admin key. Default: RFM_ADMIN_KEY.", show_default=False)
]
TritonPath = Annotated[
    Path | None,
    typer.Option(
        "--tritonserver", help="The tritonserver program. Default: from PATH, else from the nvidia-pytriton wheel."
    ),
]


class RfmCommand(command.Command):
    """Command class for ``rfm``: reports an expected error on one line and exits with 1."""

    program = "rfm"
    has_codes = False


class RfmCommands(command.Commands):
    """Command group for ``rfm``, which refers to ``rfm-client`` for commands that exist only there."""

    program, other_program = "rfm", "rfm-client"
    elsewhere = ("score", "compare", "status", "wait", "sample", "bench", "evaluate")
    missing: ClassVar[dict[str, str]] = {"label": "pip install ./client ./apps/labels ."}


@contextmanager
def timed_steps() -> Iterator[Callable[[str], None]]:
    """Yield a function that begins a step. Each step's begin, and at its end its seconds, go to standard error."""
    begun: list[tuple[str, float]] = []

    def end() -> None:
        for step, began_s in begun:
            say(f"{step}: {time.monotonic() - began_s:.0f} s")
        begun.clear()

    def begin(step: str) -> None:
        end()
        say(f"{step} ...")
        begun.append((step, time.monotonic()))

    yield begin
    end()


def say(line: str) -> None:
    """Write a line to standard error."""
    command.report(line, RfmCommand.program)


def fail(message: str) -> NoReturn:
    """Write the message to standard error and exit with 1."""
    say(message)
    raise typer.Exit(command.ExitCode.FAILED)
