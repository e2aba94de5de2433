# SPDX-License-Identifier: MIT
"""Settings: frozen dataclasses whose fields have a help text and bounds, for files and command lines."""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeAlias

Texts: TypeAlias = tuple[str, ...]

_PLAIN: dict[Any, tuple[type, ...]] = {Path: (str,), float: (int, float), Texts: (list,)}  # else the type itself
_NAMES: dict[Any, str] = {types.NoneType: "null", Path: "str", Texts: "list of str"}


class ConfigError(ValueError):
    """A setting with an invalid value.

    key: name of the setting, or several names with commas between
    expected: ``expected X, got Y``
    """

    def __init__(self, key: str, expected: str) -> None:
        super().__init__(f"{key}: {expected}")
        self.key = key
        self.expected = expected


@dataclass(frozen=True)
class Setting:
    """One field of a ``Settings``.

    least, most: bounds of a number
    flag: option on a command line; None: made from ``name``
    metavar: placeholder for the value in a command's help
    variable: environment variable for the value
    parse: converts the text on a command line to the value; raises ValueError
    has_option: False: only files and programs set it
    """

    name: str
    kind: Any
    default: Any
    help: str
    least: float | None = None
    most: float | None = None
    flag: str | None = None
    metavar: str | None = None
    variable: str | None = None
    parse: Callable[[str], Any] | None = None
    has_option: bool = True

    @property
    def option(self) -> str:
        """Option of this setting, in a command without another setting of the same name."""
        return self.flag or f"--{self.name.replace('_', '-')}"

    def from_plain(self, value: Any) -> Any:
        """Convert a plain value of YAML or JSON. Raises ConfigError for a wrong type."""
        for kind in self._kinds:
            if _spells(value, kind):
                return None if value is None else kind(value)
        raise ConfigError(self.name, f"expected {self._expected}, got {value!r:.200}")

    def check(self, value: Any) -> None:
        """Raise ConfigError for a value out of bounds or not among the choices."""
        if value is None:
            return
        if self._choices and value not in self._choices:
            raise ConfigError(self.name, f"expected {self._expected}, got {value!r:.200}")
        if self.least is not None and not _is_number(value):
            raise ConfigError(self.name, f"expected a finite number, got {value!r:.200}")
        if self.least is not None and value < self.least:
            raise ConfigError(self.name, f"expected at least {self.least}, got {value}")
        if self.most is not None and value > self.most:
            raise ConfigError(self.name, f"expected at most {self.most}, got {value}")

    @property
    def _parts(self) -> tuple[Any, ...]:
        is_union = typing.get_origin(self.kind) in (types.UnionType, typing.Union)
        return typing.get_args(self.kind) if is_union else (self.kind,)

    @property
    def _choices(self) -> Texts:
        """Texts to choose from; empty: any value."""
        return tuple(
            text for part in self._parts if typing.get_origin(part) is Literal for text in typing.get_args(part)
        )

    @property
    def _kinds(self) -> tuple[Any, ...]:
        return tuple(str if typing.get_origin(part) is Literal else part for part in self._parts)

    @property
    def _expected(self) -> str:
        kinds = [kind for kind in self._kinds if not (self._choices and kind is str)]
        choices = [f"one of {', '.join(self._choices)}"] if self._choices else []
        return " or ".join([*choices, *(_NAMES.get(kind) or kind.__name__ for kind in kinds)])


def setting(default: Any, help: str, **more: Any) -> Any:
    """Return a field of a ``Settings``; ``more`` are fields of ``Setting``."""
    return field(default=default, metadata={"help": help, **more})


class Settings:
    """Base of frozen dataclasses whose fields are made by ``setting``. Raises ConfigError for an invalid value.

    TITLE: heading of their options in a command's help
    """

    TITLE: ClassVar[str] = "Options"

    def __post_init__(self) -> None:
        for each in settings_of(type(self)).values():
            each.check(getattr(self, each.name))


def settings_of(kind: Any) -> dict[str, Setting]:
    """Return the settings of a ``Settings`` class by name, in their order."""
    hints = typing.get_type_hints(kind)
    return {each.name: Setting(each.name, hints[each.name], each.default, **each.metadata) for each in fields(kind)}


def _is_number(value: Any) -> bool:
    """True for an int or a finite float. Not isinstance, for which True is an int."""
    return type(value) is int or (type(value) is float and math.isfinite(value))


def _spells(value: Any, kind: Any) -> bool:
    """True if a plain value has this type. Not isinstance, for which True is an int."""
    is_plain = type(value) in _PLAIN.get(kind, (kind,))
    return is_plain and (kind != Texts or all(type(each) is str for each in value))
