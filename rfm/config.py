# SPDX-License-Identifier: MIT
"""ServeConfig: one YAML file -> one frozen dataclass -> config.pbtxt and the arguments of tritonserver."""

from __future__ import annotations

import types
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

if TYPE_CHECKING:
    import torch

DEFAULT_HOST = "127.0.0.1"
DEFAULT_TOKEN_BUDGET = 16_384
MAX_PORT = 65_535
_PORTS = ("server_port", "grpc_port", "metrics_port", "gateway_port")
_DTYPES = ("float32", "bfloat16", "float16")


class ConfigError(Exception):
    """A configuration that cannot be used: which file, which key, what was expected."""


@dataclass(frozen=True)
class ServeConfig:
    """How a checkpoint is exported and served.

    Keys of the FastAPI evaluation server:

    model_path: the checkpoint; ``--checkpoint`` of ``rfm export``
    num_gpus: GPUs to use, one instance of the model on each; null: all there are, the CPU if there are none; 0: the CPU
    batch_size: the most samples of one batch (``max_batch_size``), whoever sent them
    max_workers: threads that read HTTP requests; null: Triton's choice. Batches need no workers here
    server_url: address to listen on, with or without ``http://``
    server_port: HTTP port

    Keys of this server:

    name: of the model in the repository; raw frames are scored by ``<name>_frames``
    image_encoder, text_encoder: folders or Hugging Face ids of a ReWiND checkpoint's encoders
    base_model: folder or id of a vision-language checkpoint's base model; else the one that the checkpoint names
    dtype: float32, bfloat16 or float16 of a vision-language network; null: the checkpoint's on a GPU, else float32
    token_budget: the most tokens, padding included, of one forward pass
    torch_threads: CPU threads of each model instance; 0: torch's choice
    grpc_port, metrics_port: Triton's other two ports
    gateway_port: of the FastAPI evaluation server's endpoints before it; null: there are none
    """

    model_path: str | None = None
    num_gpus: int | None = None
    batch_size: int = 64
    max_workers: int | None = None
    server_url: str = DEFAULT_HOST
    server_port: int = 8000
    name: str = "rfm"
    image_encoder: str | None = None
    text_encoder: str | None = None
    base_model: str | None = None
    dtype: str | None = None
    token_budget: int = DEFAULT_TOKEN_BUDGET
    torch_threads: int = 0
    grpc_port: int = 8001
    metrics_port: int = 8002
    gateway_port: int | None = None

    def __post_init__(self) -> None:
        _at_least(1, self, "batch_size", "max_workers", "token_budget", *_PORTS)
        _at_least(0, self, "num_gpus", "torch_threads")
        if self.dtype not in (None, *_DTYPES):
            raise ConfigError(f"dtype: expected one of {', '.join(_DTYPES)} or null, got {self.dtype!r}")
        ports = {name: getattr(self, name) for name in _PORTS if getattr(self, name) is not None}
        if max(ports.values()) > MAX_PORT or len(set(ports.values())) < len(ports):
            raise ConfigError(f"ports: expected different ones up to {MAX_PORT}, got {ports}")
        if ":" in self.host:
            raise ConfigError(f"server_url: expected an address without port (server_port), got {self.server_url!r}")
        if not self.name.replace("_", "").replace("-", "").isalnum():
            raise ConfigError(f"name: expected letters, digits, _ and -, got {self.name!r}")

    @classmethod
    def from_yaml(cls, file: str | Path) -> ServeConfig:
        """Reads the file. Raises ConfigError for what is not YAML, unknown keys and values of the wrong type."""
        try:
            content = yaml.safe_load(Path(file).read_text())
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise ConfigError(f"{file}: expected a YAML file, got {error}") from error
        if content is None:
            content = {}
        if not isinstance(content, dict):
            raise ConfigError(f"{file}: expected keys and values, got {type(content).__name__}")
        types_of = typing.get_type_hints(cls)
        for key, value in content.items():
            if key not in types_of:
                raise ConfigError(f"{file}: {key}: expected one of {', '.join(types_of)}, got an unknown key")
            if not _fits(value, types_of[key]):
                raise ConfigError(f"{file}: {key}: expected {_name(types_of[key])}, got {value!r}")
        try:
            return cls(**content)
        except ConfigError as error:
            raise ConfigError(f"{file}: {error}") from None

    @property
    def host(self) -> str:
        """``server_url`` as an address to listen on."""
        host = self.server_url.partition("://")[2] or self.server_url
        host = host.rstrip("/")
        return DEFAULT_HOST if host == "localhost" else host

    @property
    def torch_dtype(self) -> torch.dtype | None:
        """``dtype`` as torch has it."""
        import torch  # here, since only few of those who read a configuration need it

        return getattr(torch, self.dtype) if self.dtype else None

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can reach it."""
        return self.host.startswith("127.")


def _at_least(least: int, config: ServeConfig, *keys: str) -> None:
    for key in keys:
        value = getattr(config, key)
        if value is not None and value < least:
            raise ConfigError(f"{key}: expected at least {least}, got {value}")


def _fits(value: Any, expected: Any) -> bool:
    if isinstance(expected, types.UnionType):
        return any(_fits(value, kind) for kind in typing.get_args(expected))
    return type(value) is expected  # not isinstance: True is no number of GPUs


def _name(expected: Any) -> str:
    if isinstance(expected, types.UnionType):
        return " or ".join(_name(kind) for kind in typing.get_args(expected))
    return "null" if expected is type(None) else str(expected.__name__)
