# SPDX-License-Identifier: MIT
"""The sections of a command's help: arguments, options, groups of settings, servers and credentials."""

from __future__ import annotations

from typing import Any

MOST_COLUMNS = 110  # of a help text, in a terminal as wide

_FIRST, _LAST = ("Arguments", "Options"), ("Server", "Credentials")


def write_options(command: Any, ctx: Any, formatter: Any) -> None:
    """Write a section for each group of parameters; required ones stand first in a section."""
    sections: dict[str, list[tuple[str, str]]] = {title: [] for title in _FIRST}
    for parameter in sorted(command.get_params(ctx), key=lambda each: not each.required):
        record = parameter.get_help_record(ctx)
        if record is not None:
            is_argument = parameter.param_type_name == "argument"
            record = (argument_name(parameter), record[1]) if is_argument else record
            title = "Arguments" if is_argument else getattr(parameter, "rich_help_panel", None) or "Options"
            sections.setdefault(title, []).append(record)
    last = [title for title in _LAST if title in sections]
    for title in [*(title for title in sections if title not in last), *last]:
        if sections[title]:
            with formatter.section(title):
                formatter.write_dl(sections[title])


def argument_name(parameter: Any) -> str:
    """Return an argument's name as the usage line and the help write it."""
    return str(parameter.metavar or parameter.name.upper())
