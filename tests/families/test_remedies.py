# SPDX-License-Identifier: MIT
"""Messages of checkpoints and exports name options and extras that exist. Commands are run where each is refused."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import tomllib
import typer
from click import Command

from paths import ROOT
from rfm_commands.cli import app

SERVING = {"serve", "triton_model"}  # these name options of tritonserver, too
FILES = [
    file
    for part in ("rfm", "export/rfm_export")
    for file in sorted((ROOT / part).rglob("*.py"))
    if not SERVING & set(file.parts)
]
STRINGS = [
    node.value
    for file in FILES
    for node in ast.walk(ast.parse(file.read_text()))
    if isinstance(node, ast.Constant) and isinstance(node.value, str)
]


def options(command: Command) -> Iterator[str]:
    for parameter in command.params:
        yield from (*parameter.opts, *parameter.secondary_opts)
    for subcommand in getattr(command, "commands", {}).values():
        yield from options(subcommand)


def test_options_exist() -> None:
    known = {*options(typer.main.get_command(app))}
    named = {name for text in STRINGS for name in re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)}
    assert len(named) > 15
    assert sorted(named - known) == []


def test_extras_exist() -> None:
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = {name for text in STRINGS for name in re.findall(r'pip install "\.\[(\w+)\]"', text)}
    assert named == {"encoders", "vlm", "quantized"}
    assert named <= known.keys()
