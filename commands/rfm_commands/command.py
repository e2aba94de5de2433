# SPDX-License-Identifier: MIT
"""Shared parts of ``rfm``'s commands: options, errors on one line, lines for the user."""

from __future__ import annotations

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
    """Yield a function that begins a step. A terminal shows each step with its time; standard error else nothing."""
    from rich.console import Console
    from rich.progress import Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = TextColumn(f"{RfmCommand.program}: {{task.description}}"), TimeElapsedColumn()
    with Progress(*columns, console=console, disable=not console.is_terminal) as steps:

        def begin(step: str) -> None:
            for task in steps.task_ids:
                steps.stop_task(task)
            steps.add_task(step, total=None)

        yield begin


def say(line: str) -> None:
    """Write a line to standard error."""
    command.report(line, RfmCommand.program)


def fail(message: str) -> NoReturn:
    """Write the message to standard error and exit with 1."""
    say(message)
    raise typer.Exit(command.ExitCode.FAILED)
