# SPDX-License-Identifier: MIT
"""The commands ``rfm`` and ``rfm-client`` in this process, which saves seconds of imports."""

from __future__ import annotations

from typing import Any

from typer.main import get_command
from typer.testing import CliRunner, Result

from rfm_client.cli.commands import app as rfm_client_app
from rfm_commands.cli import app as rfm_app


def rfm(*words: object, **options: Any) -> Result:
    """Run ``rfm``. options: of ``CliRunner.invoke``, such as env"""
    return CliRunner().invoke(rfm_app, [str(word) for word in words], catch_exceptions=False, **options)


def rfm_parsed(command: str, *words: str) -> dict[str, Any]:
    """Parse words as ``rfm`` does, without running it: the value of each option and argument, by name."""
    context = get_command(rfm_app).commands[command].make_context(command, [*words])  # type: ignore[attr-defined]
    given = {each.name: each.opts[0].lstrip("-").replace("-", "_") for each in context.command.params}
    return context.params | {given[name]: value for name, value in context.params.items()}


def rfm_client(*words: object, **options: Any) -> Result:
    """Run ``rfm-client``. options: of ``CliRunner.invoke``, such as env"""
    return CliRunner().invoke(rfm_client_app, [str(word) for word in words], catch_exceptions=False, **options)
