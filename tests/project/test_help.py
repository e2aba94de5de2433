# SPDX-License-Identifier: MIT
"""``--help`` in a narrow terminal."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from click import Command
from click.testing import CliRunner
from typer.main import get_command

from in_process import rfm_app, rfm_client_app
from rfm.config import ServeConfig
from rfm_gateway import GatewayConfig

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
    listed = shown.partition("Commands:")[2]
    assert "..." not in listed
    assert "…" not in shown


@pytest.mark.parametrize("name", COMMANDS)
def test_no_name_and_no_sentence_is_cut_off(name: str) -> None:
    top = COMMANDS[name.split()[0]]
    done = CliRunner().invoke(top, [*name.split()[1:], "--help"], env=COMMON, prog_name=name.split()[0])
    assert done.exit_code == 0
    assert_whole(done.output, COMMANDS[name])


def test_a_command_of_the_other_program_is_told_with_that_program() -> None:
    for program, other in (("rfm", "rfm-client"), ("rfm-client", "rfm")):
        names = {each.split()[1]: each for each in COMMANDS if each.startswith(f"{other} ")}
        missing = [name for name in names if f"{program} {name}" not in COMMANDS]
        assert missing
        for name in missing:
            done = CliRunner().invoke(COMMANDS[program], [name, "a.mp4"], env=COMMON, prog_name=program)
            assert done.exit_code == 2
            assert f"No such command '{name}': that is `{other} {name}`" in done.stderr


def test_a_renamed_command_is_told_with_the_new_name() -> None:
    done = CliRunner().invoke(COMMANDS["rfm"], ["demo", "--video", "a.mp4"], env=COMMON, prog_name="rfm")
    assert (done.exit_code, done.stderr.splitlines()[-1]) == (2, "Error: No such command 'demo': it is now `rfm try`")


def test_the_help_of_each_program_names_the_other() -> None:
    for program, other in (("rfm", "rfm-client --help"), ("rfm-client", "rfm --help")):
        shown = CliRunner().invoke(COMMANDS[program], ["--help"], env=COMMON, prog_name=program).output
        assert other in " ".join(shown.split())


@pytest.mark.parametrize("name", [name for name, command in COMMANDS.items() if not hasattr(command, "commands")])
def test_each_command_has_an_example_of_itself_before_the_options(name: str) -> None:
    top = COMMANDS[name.split()[0]]
    shown = CliRunner().invoke(top, [*name.split()[1:], "--help"], env=COMMON, prog_name=name.split()[0]).output
    (example,) = re.findall(r"^  Example: (.*)$", shown, re.MULTILINE)
    named = {name, name.replace("rfm ", "rfm-client ")}  # `rfm gateway` is the same command
    assert any(example.startswith(f"{each} ") for each in named)
    assert shown.index("Example:") < shown.index("  -h, --help")
    context = COMMANDS[name].make_context(name, shlex.split(example)[len(name.split()) :])
    assert all(context.params[each.name] is not None for each in COMMANDS[name].params if each.required and each.name)


def test_options_stand_in_groups() -> None:
    shown = CliRunner().invoke(COMMANDS["rfm"], ["serve", "--help"], env=COMMON, prog_name="rfm").output
    places = [shown.index(f"\n{title}:\n") for title in ("Options", ServeConfig.TITLE, GatewayConfig.TITLE)]
    assert places == sorted(places)


def test_what_is_needed_stands_first_and_certificates_last() -> None:
    shown = CliRunner().invoke(COMMANDS["rfm-client"], ["gateway", "--help"], env=COMMON).output
    options = re.findall(r"^  (--[\w-]+)", shown.partition("Gateway:")[2], re.MULTILINE)
    assert options[0] == "--triton"
    assert options[-5:] == ["--certificate", "--key", "--triton-ca-file", "--triton-certificate", "--triton-key"]
    shown = CliRunner().invoke(COMMANDS["rfm-client"], ["--help"], env=COMMON).output
    assert shown.index("\nCommands:") < shown.index("\nOptions:") < shown.index("\nCredentials:")


@pytest.mark.parametrize("name", COMMANDS)
def test_defaults_bounds_and_placeholders_are_as_one_writes_them(name: str) -> None:
    top = COMMANDS[name.split()[0]]
    shown = " ".join(CliRunner().invoke(top, [*name.split()[1:], "--help"], env=COMMON).output.split())
    for unwritten in ("None", "<", "factory", "True", "False", "list[", "x>=", ".0;", ".0]", "PosixPath", "2147483647"):
        assert unwritten not in shown


DEFAULTS = {
    "rfm-client score": ["default: grpc://localhost:8001; variable: RFM_URL", "default: 60", "default: --subsample"],
    "rfm-client label": ["default: --picture", "default: 4", "variable: RFM_API_KEY_FILE"],
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


def test_what_chooses_frames_stands_in_one_group_of_score() -> None:
    shown = CliRunner().invoke(COMMANDS["rfm-client"], ["score", "--help"], env=COMMON).output
    _, _, below = shown.partition("\nFrames:\n")
    group, _, _ = below.partition("\n\n")
    first_words = [line.split()[0] for line in group.splitlines() if line.startswith("  --")]
    assert first_words == ["--fps", "--max-frames", "--subsample", "--sampling", "--frames", "--frame-steps"]


@pytest.mark.parametrize("name", ["rfm-client score", "rfm-client compare", "rfm-client label"])
def test_the_server_stands_last(name: str) -> None:
    shown = CliRunner().invoke(COMMANDS["rfm-client"], [*name.split()[1:], "--help"], env=COMMON).output
    titles = re.findall(r"^(\w[\w -]*):$", shown, re.MULTILINE)
    assert titles[-2:] == ["Server", "Credentials"]


ALTERNATIVES = {
    "rfm label": "rfm-client label",
    "rfm-client label": "rfm label",
    "rfm gateway": "rfm serve --gateway-port",
    "rfm-client gateway": "rfm serve --gateway-port",
    "rfm serve": "--gateway-port",
}


@pytest.mark.parametrize(("name", "other"), ALTERNATIVES.items(), ids=ALTERNATIVES)
def test_help_says_which_other_command_does_the_same_job(name: str, other: str) -> None:
    shown = " ".join(str(COMMANDS[name].help).split())
    assert other in shown


def test_so_it_is_where_there_is_the_gateway_alone(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "rfm_gateway", "--help"], env=COMMON, cwd=tmp_path, text=True, capture_output=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert_whole(done.stdout, COMMANDS["rfm gateway"])
