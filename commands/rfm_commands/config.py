# SPDX-License-Identifier: MIT
"""One YAML file for everything that is served: a section for each time at which its keys take effect."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

from rfm.config import ExportConfig, ServeConfig
from rfm.plain_yaml import read_yaml
from rfm_client.contract.settings import ConfigError, Settings, settings_of
from rfm_gateway.config import GatewayConfig

Values: TypeAlias = dict[str, dict[str, Any]]  # by section and key

SECTIONS: dict[str, type[Settings]] = {"export": ExportConfig, "serve": ServeConfig, "gateway": GatewayConfig}
LIFETIMES = {"export": "at export", "serve": "at serve", "gateway": "in the gateway"}

# Keys of a file without sections, such as the FastAPI server's, and what they are called in one. New keys get none.
FLAT_KEYS = {
    "model_path": "export.checkpoint",
    "server_url": "serve.host",
    "server_port": "serve.http_port",
    "max_workers": "serve.http_threads",
    "gateway_port": "gateway.port",
    "name": "export.name",
    "num_gpus": "export.num_gpus",
    "instances": "export.instances",
    "torch_threads": "export.torch_threads",
    "max_batch_size": "export.max_batch_size",
    "token_budget": "export.token_budget",
    "max_sample_tokens": "export.max_sample_tokens",
    "dtype": "export.dtype",
    "image_encoder": "export.image_encoder",
    "text_encoder": "export.text_encoder",
    "base_model": "export.base_model",
    "max_queue_size": "export.max_queue_size",
    "queue_timeout_ms": "export.queue_timeout_ms",
    "batch_size": "export.batch_size",
    "grpc_port": "serve.grpc_port",
    "metrics_port": "serve.metrics_port",
    "status_port": "serve.status_port",
    "grpc_certificate": "serve.grpc_certificate",
    "grpc_key": "serve.grpc_key",
    "grpc_client_ca": "serve.grpc_client_ca",
    "canary_s": "serve.canary_s",
    "hang_s": "serve.hang_s",
    "triton_silent_s": "serve.triton_silent_s",
}


@dataclass(frozen=True)
class File:
    """What a file sets.

    values: as YAML spells them; flat: the keys that stand outside a section, by their names in one
    """

    path: Path | None = None
    values: Values = field(default_factory=lambda: {section: {} for section in SECTIONS})
    flat: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> File:
        """Reads the file. Raises ConfigError for what is not YAML, and for unknown keys."""
        try:
            content = read_yaml(path)
        except (OSError, ValueError) as error:
            raise ConfigError(str(path), f"expected a YAML file, got {error}") from error
        file = cls(path)
        flat = {}
        for written, name, value in _entries(content, path):
            section, _, key = name.partition(".")
            if key in file.values[section]:
                raise ConfigError(f"{path}: {written}", f"expected once, got {name} twice")
            file.values[section][key] = value
            if written != name:
                flat[name] = written
        return replace(file, flat=flat)

    def sections(self) -> dict[str, Any]:
        """Each section as ``Config`` has it. Raises ConfigError for the key, as it stands in the file."""
        made: dict[str, Any] = {}
        for section, kind in SECTIONS.items():
            known, values = settings_of(kind), self.values[section]
            try:
                made[section] = kind(**{key: known[key].from_plain(value) for key, value in values.items()})
            except ConfigError as error:
                name = f"{section}.{error.key}"
                raise ConfigError(f"{self.path}: {self.flat.get(name, name)}", error.expected) from None
        return made


@dataclass(frozen=True)
class Config:
    """All that one file sets, and the options that win over it.

    export, serve, gateway: its sections; gateway.port None: there is no gateway
    file: what the file itself says
    """

    export: ExportConfig = field(default_factory=ExportConfig)
    serve: ServeConfig = field(default_factory=ServeConfig)
    gateway: GatewayConfig = field(default_factory=GatewayConfig)
    file: File = field(default_factory=File, repr=False, compare=False)

    def __post_init__(self) -> None:
        serve = self.serve
        ports = {f"serve.{name}": getattr(serve, name) for name in settings_of(ServeConfig) if name.endswith("_port")}
        ports["gateway.port"] = self.gateway.port
        taken = {name: port for name, port in ports.items() if port is not None}
        if len(set(taken.values())) < len(taken):
            raise ConfigError("ports", f"expected different ones, got {taken}")

    @classmethod
    def from_yaml(cls, path: str | Path) -> Config:
        """Reads the file. Raises ConfigError for what is not YAML, unknown keys and values that cannot be used."""
        file = File.read(Path(path))
        sections = file.sections()
        try:
            return cls(**sections, file=file)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error.key}", error.expected) from None

    def with_options(self, **sections: Mapping[str, Any]) -> Config:
        """The same with values by section and key. Raises ConfigError."""
        changed = {}
        for section, values in sections.items():
            try:
                changed[section] = replace(getattr(self, section), **values)
            except ConfigError as error:
                raise ConfigError(f"{section}.{error.key}", error.expected) from None
        return replace(self, **changed)


def _entries(content: Any, path: Path) -> Iterator[tuple[str, str, Any]]:
    """Of each key how the file writes it, what it is called in its section (``section.key``), and its value."""
    for key, value in _items(content, str(path)):
        if key in FLAT_KEYS:
            yield key, FLAT_KEYS[key], value
        elif key in SECTIONS:
            known = settings_of(SECTIONS[key])
            for inner, each in _items(value, f"{path}: {key}"):
                if inner not in known:
                    raise _unknown(f"{path}: {key}.{inner!s:.100}", known)
                yield f"{key}.{inner}", f"{key}.{inner}", each
        else:
            raise _unknown(f"{path}: {key!s:.100}", (*SECTIONS, *FLAT_KEYS))


def _items(content: Any, where: str) -> Iterable[tuple[Any, Any]]:
    """Keys and values of a mapping; null is an empty one."""
    if content is None:
        return ()
    if not isinstance(content, dict):
        raise ConfigError(where, f"expected keys and values, got {type(content).__name__}")
    return content.items()


def _unknown(where: str, known: Iterable[str]) -> ConfigError:
    return ConfigError(where, f"expected one of {', '.join(known)}, got an unknown key")
