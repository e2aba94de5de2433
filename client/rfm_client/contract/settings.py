# SPDX-License-Identifier: MIT
"""Settings: fields of a frozen dataclass that say what they mean and take, for files, command lines and documents."""

from __future__ import annotations

import math
import types
import typing
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeAlias

Texts: TypeAlias = tuple[str, ...]

_PLAIN: dict[Any, tuple[type, ...]] = {Path: (str,), float: (int, float), Texts: (list,)}  # else the type itself
_NAMES: dict[Any, str] = {types.NoneType: "null", Path: "str", Texts: "list of str"}


class ConfigError(ValueError):
    """A setting that cannot be used.

    key: which one, or several with commas between; expected: ``expected X, got Y``
    """

    def __init__(self, key: str, expected: str) -> None:
        super().__init__(f"{key}: {expected}")
        self.key = key
        self.expected = expected


@dataclass(frozen=True)
class Setting:
    """One field of a ``Settings``.

    least, most: bounds of a number; one_of: the texts that it takes, if not any
    has_option: whether commands have an option for it
    """

    name: str
    kind: Any
    default: Any
    help: str
    least: float | None = None
    most: float | None = None
    one_of: Texts = ()
    has_option: bool = True

    @property
    def option(self) -> str:
        """The option of this setting, in a command that has no other settings of that name."""
        return f"--{self.name.replace('_', '-')}"

    @property
    def no_option(self) -> str:
        """The option that says no, of a setting that is true or false."""
        return f"--no-{self.name.replace('_', '-')}"

    def from_plain(self, value: Any) -> Any:
        """The value that YAML or JSON spells so. Raises ConfigError for one of another type."""
        kinds = typing.get_args(self.kind) if isinstance(self.kind, types.UnionType) else (self.kind,)
        for kind in kinds:
            if _spells(value, kind):
                return None if value is None else kind(value)
        names = " or ".join(_NAMES.get(kind) or kind.__name__ for kind in kinds)
        raise ConfigError(self.name, f"expected {names}, got {value!r:.200}")

    def check(self, value: Any) -> None:
        """Raises ConfigError for a value that is out of bounds."""
        if value is None:
            return
        if self.least is not None and not _is_number(value):
            raise ConfigError(self.name, f"expected a finite number, got {value!r:.200}")
        if self.least is not None and value < self.least:
            raise ConfigError(self.name, f"expected at least {self.least}, got {value}")
        if self.most is not None and value > self.most:
            raise ConfigError(self.name, f"expected at most {self.most}, got {value}")
        if self.one_of and value not in self.one_of:
            raise ConfigError(self.name, f"expected one of {', '.join(self.one_of)} or null, got {value!r}")


def setting(default: Any, help: str, **more: Any) -> Any:
    """A field of a ``Settings``. more: fields of ``Setting``"""
    return field(default=default, metadata={"help": help, **more})


class Settings:
    """Base of frozen dataclasses whose fields are each a ``setting``. Raises ConfigError for what is out of bounds."""

    def __post_init__(self) -> None:
        for each in settings_of(type(self)).values():
            each.check(getattr(self, each.name))


def settings_of(kind: Any) -> dict[str, Setting]:
    """The settings of a ``Settings`` by name, in their order."""
    hints = typing.get_type_hints(kind)
    return {each.name: Setting(each.name, hints[each.name], each.default, **each.metadata) for each in fields(kind)}


def _is_number(value: Any) -> bool:
    """Whether it is an int, or a float that is neither NaN nor infinite; not what isinstance says: True is none."""
    return type(value) is int or (type(value) is float and math.isfinite(value))


def _spells(value: Any, kind: Any) -> bool:
    """Whether a plain value is of this type; not what isinstance says: True is no number."""
    is_plain = type(value) in _PLAIN.get(kind, (kind,))
    return is_plain and (kind != Texts or all(type(each) is str for each in value))
