# SPDX-License-Identifier: MIT
"""Messages in command-line terms, and the sections in a command's help.

No library texts, no Python function arguments.
"""

from __future__ import annotations

from typing import Any

import typer

from rfm_client.contract.errors import LocatedError
from rfm_client.contract.triton import FEWER_FRAMES

MOST_COLUMNS = 110  # widest help text, if the terminal is that wide

_FIRST, _LAST = ("Arguments", "Options"), ("Server", "Credentials")  # sections in a help text
UsageError: type[Exception] = typer.BadParameter.__mro__[1]  # from click, or from typer's own copy of click
_EXPECTED = {"int_parsing": "a whole number", "int_from_float": "a whole number", "float_parsing": "a number"}


def user_message(error: Exception) -> str:
    """Return the message for a command-line user, who knows options but not Python function arguments."""
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return str(with_remedy(error, "leave --no-subsample out, or score prefixes (--sampling)"))


def with_remedy(error: Exception, remedy: str) -> Exception:
    """Return a too-many-frames error with this remedy, or none if empty; return other errors as they are."""
    if isinstance(error, LocatedError) and error.remedy == FEWER_FRAMES:
        return type(error).at(error.where, error.expected, error.got, remedy)
    return error


def in_plain_words(error: typer.BadParameter) -> str:
    """Return the message for an invalid value, without the words of pydantic, which typer validates with."""
    details: list[Any] = getattr(error.__cause__, "errors", list)()
    expected = _EXPECTED.get(details[0]["type"]) if details else None
    if expected is None:
        return error.message.removeprefix("Value error, ")
    return f"expected {expected}, got {details[0]['input']!r}"


def write_options(command: Any, ctx: Any, formatter: Any) -> None:
    """Write a section for each parameter group; required parameters come first in a section."""
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
    """Return an argument's name as shown in the usage line and the help."""
    return str(parameter.metavar or parameter.name.upper())
