# SPDX-License-Identifier: MIT
"""``--help`` in a narrow terminal."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator

import pytest
from click import Command
from click.testing import CliRunner
from typer.main import get_command

from in_process import rfm_app, rfm_client_app

COMMON = {"COLUMNS": "80", "TERMINAL_WIDTH": "80"}


def commands(name: str, command: Command) -> Iterator[tuple[str, Command]]:
    """Yield the command and all subcommands with the words to type."""
    yield name, command
    for inner, below in getattr(command, "commands", {}).items():
        yield from commands(f"{name} {inner}", below)


COMMANDS = {**dict(commands("rfm", get_command(rfm_app))), **dict(commands("rfm-client", get_command(rfm_client_app)))}


def assert_whole(shown: str, command: Command) -> None:
    words = {word.strip(",/") for word in shown.split()}
    for parameter in command.params:
        options = {*parameter.opts, *parameter.secondary_opts}
        assert {option for option in options if option.startswith("--")} <= words, parameter.name
        assert parameter.param_type_name == "argument" or parameter.help, parameter.name  # type: ignore[attr-defined]
    listed = shown.partition("Commands:")[2]
    assert "..." not in listed
    assert "…" not in shown


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_whole_says_defaults_as_one_writes_them_and_has_an_example_that_the_command_takes(name: str) -> None:
    program, *words = name.split()
    done = CliRunner().invoke(COMMANDS[program], [*words, "--help"], env=COMMON, prog_name=program)
    assert done.exit_code == 0
    assert COMMANDS[name].help
    assert_whole(done.output, COMMANDS[name])
    shown = " ".join(done.output.split())
    for unwritten in ("None", "<", "factory", "True", "False", "list[", "x>=", ".0;", ".0]", "PosixPath", "2147483647"):
        assert unwritten not in shown
    if hasattr(COMMANDS[name], "commands"):
        return
    (example,) = re.findall(r"^  Example: (.*)$", done.output, re.MULTILINE)
    assert example.startswith((f"{name} ", f"{name.replace('rfm ', 'rfm-client ')} "))  # `rfm gateway` is the same
    context = COMMANDS[name].make_context(name, shlex.split(example)[len(name.split()) :])
    assert all(context.params[each.name] is not None for each in COMMANDS[name].params if each.required and each.name)


def test_a_command_of_the_other_program_is_refused_with_that_program_s_name() -> None:
    for program, other in (("rfm", "rfm-client"), ("rfm-client", "rfm")):
        names = {each.split()[1]: each for each in COMMANDS if each.startswith(f"{other} ")}
        missing = [name for name in names if f"{program} {name}" not in COMMANDS]
        assert missing
        for name in missing:
            done = CliRunner().invoke(COMMANDS[program], [name, "a.mp4"], env=COMMON, prog_name=program)
            assert done.exit_code == 2
            assert f"No such command '{name}': that is `{other} {name}`" in done.stderr


DEFAULTS = {
    "rfm-client score": ["default: grpc://localhost:8001; variable: RFM_URL", "default: 60", "default: --subsample"],
    "rfm-client label": ["default: threads", "default: 4", "variable: RFM_API_KEY_FILE"],
    "rfm-client wait": ["Time limit, in seconds. [0.001 to 86400; default: 120]"],
    "rfm gateway": ["Port to listen on. [1 to 65535; default: 8000]", "default: --viewer"],
    "rfm serve": ["--gateway-viewer / --gateway-no-viewer", "default: --gateway-viewer", "default: 127.0.0.1"],
    "rfm export": ["[0 to 4096; default: 0]", "[at least 0; default: 256]"],
    "rfm try": ["[default: model_repository]", "[default: demo_output]"],
}


@pytest.mark.parametrize(("name", "told"), DEFAULTS.items(), ids=DEFAULTS)
def test_every_default_is_shown(name: str, told: list[str]) -> None:
    program, *words = name.split()
    shown = " ".join(CliRunner().invoke(COMMANDS[program], [*words, "--help"], env=COMMON).output.split())
    for text in told:
        assert text in shown, text
