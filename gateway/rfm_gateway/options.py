# SPDX-License-Identifier: MIT
"""Options of a command from the settings that it takes, so that neither is written twice."""

from __future__ import annotations

import functools
import inspect
import types
from collections.abc import Callable, Collection
from typing import Annotated, Any, TypeAlias, get_type_hints

import typer

from rfm_client.contract.settings import ConfigError, Setting, Settings, Texts, settings_of

Given: TypeAlias = dict[str, Any]  # values of the options that were given, by the names of the settings
Command: TypeAlias = Callable[..., None]


def with_options(
    settings: type[Settings],
    into: str,
    *,
    prefix: str = "",
    only: Collection[str] | None = None,
    required: Collection[str] = (),
) -> Callable[[Command], Command]:
    """Gives a command that takes ``into: Given`` an option for each setting.

    prefix: before each option's name
    only: settings that get an option (None: all); required: those that must be given
    """
    chosen = [
        each for each in settings_of(settings).values() if each.has_option and (only is None or each.name in only)
    ]

    def decorated(command: Command) -> Command:
        @functools.wraps(command)
        def run(**options: Any) -> None:
            values = {each.name: options.pop(prefix + each.name) for each in chosen}
            given = {name: _value(value) for name, value in values.items() if value not in (None, [])}
            command(**options, **{into: given})

        hints = get_type_hints(command, include_extras=True)
        kept = [
            parameter.replace(annotation=hints[name], kind=inspect.Parameter.KEYWORD_ONLY)
            for name, parameter in inspect.signature(command).parameters.items()
            if name != into
        ]
        added = [_option(prefix, each, each.name in required) for each in chosen]
        run.__signature__ = inspect.Signature([*kept, *added])  # type: ignore[attr-defined]  # what typer reads
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in (*kept, *added)}
        return run

    return decorated


def refused(error: ConfigError, settings: type[Settings]) -> typer.BadParameter:
    """The same error, of options. Raise it."""
    known = settings_of(settings)
    names = ", ".join(known[name].option if name in known else name for name in error.key.split(", "))
    return typer.BadParameter(f"{names}: {error.expected}")


def _option(prefix: str, setting: Setting, is_required: bool) -> inspect.Parameter:
    """A parameter that is None if the option is not given: a file or the settings' own default then decides."""
    default = inspect.Parameter.empty if is_required else None
    shown = False if setting.default in (None, ()) else str(setting.default)
    option = typer.Option(
        *_switch(prefix, setting), help=setting.help, min=setting.least, max=setting.most, show_default=shown
    )
    kind = list[str] if setting.kind == Texts else setting.kind
    optional = kind if is_required or isinstance(kind, types.UnionType) else kind | None
    return inspect.Parameter(
        prefix + setting.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[optional, option],
    )


def _switch(prefix: str, setting: Setting) -> tuple[str, ...]:
    """The names of both options of a setting that is true or false; none for others, which typer names itself."""
    if setting.kind is not bool:
        return ()
    begin = "--" + prefix.replace("_", "-")
    return (f"{setting.option.replace('--', begin, 1)}/{setting.no_option.replace('--', begin, 1)}",)


def _value(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
