# SPDX-License-Identifier: MIT
"""Settings: frozen dataclasses whose fields carry help texts and bounds, for files and command lines."""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeAlias

from rfm_client.contract.checks import checked_count, checked_finite, require
from rfm_client.contract.errors import InvalidValueError

Texts: TypeAlias = tuple[str, ...]

_PLAIN: dict[Any, tuple[type, ...]] = {Path: (str,), float: (int, float), Texts: (list,)}  # otherwise the type itself
_PLACEHOLDERS: dict[Any, str | None] = {Path: "PATH", list[Path]: "PATH", int: "N", float: "NUMBER", bool: None}
_UNBOUNDED = 2**31 - 1  # a bound set only by the number's type
_NAMES: dict[Any, str] = {types.NoneType: "null", Path: "str", Texts: "list of str"}


class ConfigError(InvalidValueError):
    """An invalid setting, or two settings that do not fit together.

    where: the setting's name
    other: the second setting's name; empty: none
    """

    other = ""

    @classmethod
    def of_two(cls, name: str, relation: str, other: str) -> ConfigError:
        """Return the error for two settings: ``name needs other``, for example."""
        return cls.like(cls(relation, name), other=other)

    @classmethod
    def require_both(cls, settings: object, name: str, other: str) -> None:
        """Raise ConfigError if only one setting in a pair is given."""
        for given, missing in ((name, other), (other, name)):
            if getattr(settings, given) is not None and getattr(settings, missing) is None:
                raise cls.of_two(given, "needs", missing)

    def named(self, name_of: Callable[[str], str]) -> ConfigError:
        """Return the error with the settings renamed, as they are called elsewhere."""
        return self.like(self, where=name_of(self.where), other=name_of(self.other) if self.other else "")

    def __str__(self) -> str:
        return f"{self.where} {self.problem} {self.other}" if self.other else super().__str__()


@dataclass(frozen=True)
class Setting:
    """One field of a ``Settings``.

    default: ``MISSING``: the setting is required
    title: heading in a command's help
    least, most: bounds of a number
    flag, prefix: command-line option, and the prefix for all options; flag None: derived from ``name``
    metavar: placeholder for the value in a command's help; None: derived from ``kind``
    variable: environment variable for the value
    parse: converts command-line text to the value; raises ValueError
    has_option: False: only files and programs set it
    """

    name: str
    kind: Any
    default: Any
    title: str
    prefix: str
    has_option: bool
    help: str
    least: float | None = None
    most: float | None = None
    flag: str | None = None
    metavar: str | None = None
    variable: str | None = None
    parse: Callable[[str], Any] | None = None

    @property
    def option(self) -> str:
        """The command-line option for this setting."""
        return f"--{self.prefix}{self._flag}"

    @property
    def negation(self) -> str:
        """The option that turns this setting off."""
        return f"--{self.prefix}no-{self._flag}"

    def from_plain(self, value: Any) -> Any:
        """Convert a plain YAML or JSON value. Raises ConfigError for a wrong type."""
        for kind in self._kinds:
            if _spells(value, kind):
                return None if value is None else kind(value)
        raise ConfigError.at(self.name, self._expected, f"{value!r:.200}")

    def checked(self, value: Any) -> Any:
        """Return the value, numbers as Python's own. Raises InvalidValueError if out of bounds or not a choice."""
        if value is None:
            return None
        require(self.name, not self._choices or value in self._choices, self._expected, f"{value!r:.200}")
        if int in self._kinds:
            value = checked_count(self.name, value, least=None)
        elif float in self._kinds:
            value = checked_finite(self.name, value, "a finite number")
        require(self.name, self.least is None or value >= self.least, f"at least {self.least}", value)
        require(self.name, self.most is None or value <= self.most, f"at most {self.most}", value)
        return value

    @property
    def placeholder(self) -> str | None:
        """The value's placeholder in a command's help; None for a flag."""
        return self.metavar or placeholder_of(self.kind)

    @property
    def bounds(self) -> str:
        """Bounds of a number, in words; empty without bounds."""
        if self.least is None:
            return ""
        has_most = self.most is not None and self.most < _UNBOUNDED
        return f"{self.least:g} to {self.most:g}" if has_most else f"at least {self.least:g}"

    @property
    def _flag(self) -> str:
        return (self.flag or self.name.replace("_", "-")).removeprefix("--")

    @property
    def _choices(self) -> Texts:
        """Texts to choose from; empty: any value."""
        return _choices_of(self.kind)

    @property
    def _kinds(self) -> tuple[Any, ...]:
        return tuple(str if typing.get_origin(part) is Literal else part for part in _parts_of(self.kind))

    @property
    def _expected(self) -> str:
        kinds = [kind for kind in self._kinds if not (self._choices and kind is str)]
        choices = [f"one of {', '.join(self._choices)}"] if self._choices else []
        return " or ".join([*choices, *(_NAMES.get(kind) or kind.__name__ for kind in kinds)])


def setting(default: Any, help: str, **more: Any) -> Any:
    """Return a field for a ``Settings``; ``more`` are ``Setting`` fields. default: ``...``: required."""
    metadata = {"help": help, **more}
    return field(kw_only=True, metadata=metadata) if default is ... else field(default=default, metadata=metadata)


class Settings:
    """Base class for frozen dataclasses with fields from ``setting``. Raises ConfigError for an invalid value.

    TITLE: heading for the options in a command's help; inherited options stand under the base class's heading
    PREFIX: prefix for every option name
    NO_OPTION: settings without an option, which only files and programs set
    """

    TITLE: ClassVar[str] = "Options"
    PREFIX: ClassVar[str] = ""
    NO_OPTION: ClassVar[Collection[str]] = ()

    def __post_init__(self) -> None:
        try:
            for each in self.settings().values():
                object.__setattr__(self, each.name, each.checked(getattr(self, each.name)))
        except InvalidValueError as error:
            raise ConfigError.like(error) from None

    @classmethod
    def settings(cls) -> dict[str, Setting]:
        """Return the settings by name, in declaration order."""
        kind: Any = cls  # a dataclass
        hints, found = typing.get_type_hints(kind), {}
        for each in fields(kind):
            title = next(base.TITLE for base in kind.__mro__ if each.name in inspect.get_annotations(base))
            own = hints[each.name], each.default, title, cls.PREFIX, each.name not in cls.NO_OPTION
            found[each.name] = Setting(each.name, *own, **each.metadata)
        return found


def placeholder_of(kind: Any) -> str | None:
    """Return the help placeholder for a type: ``PATH``, ``N``, or the choices; None for a flag."""
    (part,) = (each for each in _parts_of(kind) if each is not types.NoneType)
    return "|".join(_choices_of(kind)) or _PLACEHOLDERS.get(part, "TEXT")


def _parts_of(kind: Any) -> tuple[Any, ...]:
    """Return a union's types, or the type itself."""
    return typing.get_args(kind) if typing.get_origin(kind) in (types.UnionType, typing.Union) else (kind,)


def _choices_of(kind: Any) -> Texts:
    literals = (part for part in _parts_of(kind) if typing.get_origin(part) is Literal)
    return tuple(text for part in literals for text in typing.get_args(part))


def _spells(value: Any, kind: Any) -> bool:
    """True if a plain value has this type. isinstance would accept True as an int."""
    is_plain = type(value) in _PLAIN.get(kind, (kind,))
    return is_plain and (kind != Texts or all(type(each) is str for each in value))
