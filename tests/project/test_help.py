# SPDX-License-Identifier: MIT
"""What ``--help`` shows, in the narrowest terminal that is common."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from click import Command
from click.testing import CliRunner
from typer.main import get_command

from rfm.config import ServeConfig
from rfm_client.cli.commands import app as rfm_client
from rfm_commands.cli import app as rfm
from rfm_gateway.config import GatewayConfig

COMMON = {"COLUMNS": "80", "TERMINAL_WIDTH": "80"}


def commands(name: str, command: Command) -> Iterator[tuple[str, Command]]:
    """The command and all below it, by what one types."""
    yield name, command
    for inner, below in getattr(command, "commands", {}).items():
        yield from commands(f"{name} {inner}", below)


COMMANDS = {**dict(commands("rfm", get_command(rfm))), **dict(commands("rfm-client", get_command(rfm_client)))}


def assert_whole(shown: str, command: Command) -> None:
    words = {word.strip(",/") for word in shown.split()}
    for parameter in command.params:
        options = {*parameter.opts, *parameter.secondary_opts}
        assert {option for option in options if option.startswith("--")} <= words, parameter.name
    listed = shown.partition("Commands:")[2]
    assert "..." not in listed
    assert "…" not in shown


@pytest.mark.parametrize("name", COMMANDS)
def test_no_name_and_no_sentence_is_cut_off(name: str) -> None:
    top = COMMANDS[name.split()[0]]
    done = CliRunner().invoke(top, [*name.split()[1:], "--help"], env=COMMON, prog_name=name.split()[0])
    assert done.exit_code == 0
    assert_whole(done.output, COMMANDS[name])


def test_options_stand_in_groups_and_an_example_below() -> None:
    shown = CliRunner().invoke(COMMANDS["rfm"], ["serve", "--help"], env=COMMON, prog_name="rfm").output
    places = [
        shown.index(f"\n{title}:\n") for title in ("Options", ServeConfig.TITLE, GatewayConfig.TITLE, "  Example")
    ]
    assert places == sorted(places)
    assert "\n    rfm serve my_models --gateway-port 8100 -- --log-verbose=1\n" in shown


def test_so_it_is_where_there_is_the_gateway_alone(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "rfm_gateway", "--help"], env=COMMON, cwd=tmp_path, text=True, capture_output=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert_whole(done.stdout, COMMANDS["rfm gateway"])
