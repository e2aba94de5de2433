# SPDX-License-Identifier: MIT
"""The YAML file for ``rfm``: sections export, serve and gateway, by the time at which keys take effect."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any, ClassVar

from rfm.config import ExportConfig, ServeConfig, address_of
from rfm.plain_yaml import read_yaml
from rfm_client.contract.settings import ConfigError, Settings
from rfm_gateway import GatewayConfig

SECTIONS: dict[str, type[Settings]] = {"export": ExportConfig, "serve": ServeConfig, "gateway": GatewayConfig}


@dataclass(frozen=True)
class GatewayBeside(GatewayConfig):
    """Settings for a gateway that ``rfm serve`` runs."""

    PREFIX: ClassVar[str] = "gateway-"


FASTAPI_KEYS = {  # the FastAPI server's keys, and the settings that they become here
    "model_path": "export.checkpoint",
    "num_gpus": "export.num_gpus",
    "batch_size": "export.batch_size",
    "max_workers": "serve.http_threads",
    "server_url": "gateway.host",
    "server_port": "gateway.port",
    "use_frame_steps": "gateway.use_frame_steps",
}

_PORT_REMEDY = "leave Triton's out, and rfm serve chooses it"


@dataclass(frozen=True)
class Config:
    """Settings from the file, overridden by options. Raises ConfigError for a port used twice.

    gateway.port: None: no gateway
    """

    export: ExportConfig = field(default_factory=ExportConfig)
    serve: ServeConfig = field(default_factory=ServeConfig)
    gateway: GatewayConfig = field(default_factory=GatewayConfig)

    def __post_init__(self) -> None:
        serve = self.serve
        ports = {f"serve.{name}": getattr(serve, name) for name in ServeConfig.settings() if name.endswith("_port")}
        ports["gateway.port"] = self.gateway.port
        given = [(name, port) for name, port in ports.items() if port is not None]
        for (name, port), (other, other_port) in combinations(given, 2):
            if port == other_port:
                where = f"{_with_option(name)} and {_with_option(other)}"
                raise ConfigError.at(where, "different ports", f"{port} for both", _PORT_REMEDY)

    @classmethod
    def from_yaml(cls, path: str | Path) -> Config:
        """Read the file. Raises ConfigError for invalid YAML, unknown keys and unusable values."""
        try:
            content = read_yaml(Path(path))
        except (OSError, ValueError) as error:
            raise ConfigError.at(str(path), "a YAML file", error) from error
        values: dict[str, dict[str, Any]] = {section: {} for section in SECTIONS}
        written: dict[str, str] = {}  # a setting's key in the file, for messages
        try:
            for name, setting, value in _entries(content):
                section, _, key = setting.partition(".")
                if key in values[section]:
                    raise ConfigError.at(name, "once", f"{setting} twice")
                values[section][key] = value
                written[setting] = name
            return cls(**{section: _made(section, values[section], written) for section in SECTIONS})
        except ConfigError as error:
            raise error.like(error, where=f"{path}: {error.where}" if error.where else str(path)) from None

    def with_options(self, **sections: Mapping[str, Any]) -> Config:
        """Return a copy with these values, by section and key. Raises ConfigError."""
        changed = {}
        for section, values in sections.items():
            try:
                changed[section] = replace(getattr(self, section), **values)
            except ConfigError as error:
                named = [*values, error.other] if error.where in values else values
                raise error.named(partial(named_as_typed, section, named)) from None
        return replace(self, **changed)


def named_as_typed(section: str, options: Collection[str], name: str) -> str:
    """Return the option for a setting in ``options``; for other settings the key in the file."""
    return _kind(section).settings()[name].option if name in options else f"{section}.{name}"


def _kind(section: str) -> type[Settings]:
    return GatewayBeside if section == "gateway" else SECTIONS[section]


def _with_option(setting: str) -> str:
    """Return a setting's key in the file, and its ``rfm serve`` option."""
    section, _, key = setting.partition(".")
    return f"{setting} ({_kind(section).settings()[key].option})"


def _entries(content: Any) -> Iterator[tuple[str, str, Any]]:
    """Yield each key as the file writes it, the setting (``section.key``), and the value. Raises ConfigError."""
    for key, value in _items(content, ""):
        if key in FASTAPI_KEYS:
            yield key, FASTAPI_KEYS[key], _address(value) if key == "server_url" else value
        elif key in SECTIONS:
            for inner, each in _items(value, key):
                if inner not in SECTIONS[key].settings():
                    raise _unknown(f"{key}.{inner!s:.100}", (f"{key}.{name}" for name in SECTIONS[key].settings()))
                yield f"{key}.{inner}", f"{key}.{inner}", each
        else:
            raise _unknown(f"{key!s:.100}", (*SECTIONS, *FASTAPI_KEYS))


def _address(url: Any) -> Any:
    """Return the address in the FastAPI server's ``server_url``. Raises ConfigError."""
    try:
        return address_of(url) if isinstance(url, str) else url
    except ConfigError as error:
        raise error.named(lambda _: "server_url") from None


def _made(section: str, values: Mapping[str, Any], written: Mapping[str, str]) -> Any:
    """Return a section with these values. Raises ConfigError, which names the key as the file does."""
    kind = SECTIONS[section]
    known = kind.settings()
    try:
        return kind(**{key: known[key].from_plain(value) for key, value in values.items()})
    except ConfigError as error:
        raise error.named(lambda key: written.get(f"{section}.{key}", f"{section}.{key}")) from None


def _items(content: Any, where: str) -> Iterable[tuple[Any, Any]]:
    """Return a mapping's keys and values; null is empty."""
    if content is None:
        return ()
    if not isinstance(content, dict):
        raise ConfigError.at(where, "keys and values", type(content).__name__)
    return content.items()


def _unknown(name: str, known: Iterable[str]) -> ConfigError:
    """Return the error for an unknown key, with the most similar key from any section."""
    names = [*FASTAPI_KEYS, *(f"{section}.{key}" for section, kind in SECTIONS.items() for key in kind.settings())]
    keys = [each.rpartition(".")[2] for each in names]
    close = get_close_matches(name.rpartition(".")[2], keys, 1, cutoff=0.75)
    near = [each for each, key in zip(names, keys, strict=True) if [key] == close]
    meant = f"; perhaps {' or '.join(near)}" if near else ""
    return ConfigError.at(name, f"one of {', '.join(known)}", f"an unknown key{meant}")
