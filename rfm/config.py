# SPDX-License-Identifier: MIT
"""ServeConfig: one YAML file -> one frozen dataclass -> config.pbtxt and the arguments of tritonserver."""

from __future__ import annotations

import re
import types
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rfm.plain_yaml import read_yaml
from rfm_client.contract.addresses import is_loopback

if TYPE_CHECKING:
    import torch

DEFAULT_HOST = "127.0.0.1"
DEFAULT_TOKEN_BUDGET = 16_384
DEFAULT_SAMPLE_TOKENS = 131_072
MAX_PORT = 65_535
MAX_OF_A_MACHINE = 4096  # GPUs, instances, threads
MAX_INT32 = 2**31 - 1
MAX_NAME = 100  # characters; it becomes the name of a folder
_PORTS = ("server_port", "grpc_port", "metrics_port", "gateway_port", "status_port")
_DTYPES = ("float32", "bfloat16", "float16")


class ConfigError(Exception):
    """A configuration that cannot be used: which file, which key, what was expected."""


@dataclass(frozen=True)
class ServeConfig:
    """How a checkpoint is exported and served.

    Keys of the FastAPI evaluation server:

    model_path: the checkpoint; ``--checkpoint`` of ``rfm export``
    num_gpus: GPUs to use, one instance of the model on each; null: all there are, the CPU if there are none; 0: the CPU
    batch_size: of no effect, as in the original server, which never reads it; ``max_batch_size`` bounds a batch
    max_workers: threads that read HTTP requests; null: Triton's choice. Batches need no workers here
    server_url: address to listen on, with or without ``http://``
    server_port: HTTP port

    Keys of this server:

    name: of the model in the repository; raw frames are scored by ``<name>_frames``
    image_encoder, text_encoder: folders or Hugging Face ids of a ReWiND checkpoint's encoders
    base_model: folder or id of a vision-language checkpoint's base model; else the one that the checkpoint names
    resize_images: of a vision-language checkpoint that reads frames as images and whose run set
        ``data.resized_height`` and ``data.resized_width``: whether it was trained with that size, as upstream's runs
        were before 2026-01-21; null: such a checkpoint is refused
    max_batch_size: the most samples of one batch, whoever sent them
    dtype: float32, bfloat16 or float16 of the network (not of ReWiND's encoders); null: float32, and a vision-language
        checkpoint's own on a GPU
    token_budget: the most tokens, padding included, of one forward pass of several samples; a larger one runs alone
    max_sample_tokens: the most tokens of one sample, in dense mode of one frame's; more are refused. It bounds memory
    instances: of each model, on each GPU or on the CPU; ``rfm tune`` measures what serves fastest
    torch_threads: CPU threads of each model instance; 0: on the CPU all instances of a model share its cores
    grpc_port, metrics_port: Triton's other two ports
    gateway_port: port of the gateway with the FastAPI evaluation server's endpoints; null: no gateway
    status_port: port on which ``rfm serve`` reports its own state; null: it opens none
    max_queue_size: requests that may wait for a model; more are refused at once; null: any number
    queue_timeout_ms: the longest that a request may wait; then it is refused. A request may ask for less; null: any
        time. With either, Triton 2.51 misses requests for half a second at a time where a model has one instance
    grpc_certificate, grpc_key: files (PEM) to serve gRPC with TLS; HTTP, which Triton cannot encrypt, is then open on
        127.0.0.1 alone
    grpc_client_ca: file (PEM) of who may vouch for gRPC's clients, which then need a certificate
    canary_s: seconds between two probes that ``rfm serve`` sends to a model
    hang_s: how long a model may take to get one forward pass further, or answer nobody, before ``rfm serve`` loads it
        anew
    triton_silent_s: how long Triton may give no answer, to three looks in a row, before ``rfm serve`` restarts it
    """

    model_path: str | None = None
    num_gpus: int | None = None
    batch_size: int | None = None
    max_workers: int | None = None
    server_url: str = DEFAULT_HOST
    server_port: int = 8000
    name: str = "rfm"
    image_encoder: str | None = None
    text_encoder: str | None = None
    base_model: str | None = None
    resize_images: bool | None = None
    max_batch_size: int = 64
    dtype: str | None = None
    token_budget: int = DEFAULT_TOKEN_BUDGET
    max_sample_tokens: int = DEFAULT_SAMPLE_TOKENS
    instances: int = 1
    torch_threads: int = 0
    grpc_port: int = 8001
    metrics_port: int = 8002
    gateway_port: int | None = None
    status_port: int | None = None
    max_queue_size: int | None = None
    queue_timeout_ms: int | None = None
    grpc_certificate: str | None = None
    grpc_key: str | None = None
    grpc_client_ca: str | None = None
    canary_s: int = 2
    hang_s: int = 30
    triton_silent_s: int = 10

    def __post_init__(self) -> None:
        _at_least(1, self, "batch_size", "max_batch_size", "max_workers", "instances", *_PORTS)
        _at_least(1, self, "token_budget", "max_sample_tokens")
        _at_least(1, self, "max_queue_size", "queue_timeout_ms", "canary_s", "hang_s", "triton_silent_s")
        _at_least(0, self, "num_gpus", "torch_threads")
        _at_most(MAX_OF_A_MACHINE, self, "num_gpus", "instances", "torch_threads", "max_workers")
        _at_most(MAX_INT32, self, "max_batch_size", "token_budget", "max_sample_tokens")
        _at_most(MAX_INT32, self, "max_queue_size", "queue_timeout_ms")
        if self.dtype not in (None, *_DTYPES):
            raise ConfigError(f"dtype: expected one of {', '.join(_DTYPES)} or null, got {self.dtype!r}")
        ports = {name: getattr(self, name) for name in _PORTS if getattr(self, name) is not None}
        if max(ports.values()) > MAX_PORT or len(set(ports.values())) < len(ports):
            raise ConfigError(f"ports: expected different ones up to {MAX_PORT}, got {ports}")
        if (self.grpc_certificate is None) != (self.grpc_key is None):
            raise ConfigError("grpc_certificate, grpc_key: expected both or none, got one")
        if self.grpc_client_ca is not None and self.grpc_certificate is None:
            raise ConfigError("grpc_client_ca: expected with grpc_certificate and grpc_key, got it alone")
        if ":" in self.host:
            raise ConfigError(f"server_url: expected an address without port (server_port), got {self.server_url!r}")
        if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_-]*", self.name):
            raise ConfigError(f"name: expected letters, digits, _ and -, got {self.name!r:.200}")
        if len(self.name) > MAX_NAME:
            raise ConfigError(f"name: expected at most {MAX_NAME} characters, got {len(self.name)}")

    @classmethod
    def from_yaml(cls, file: str | Path) -> ServeConfig:
        """Reads the file. Raises ConfigError for what is not YAML, unknown keys and values of the wrong type."""
        try:
            content = read_yaml(Path(file))
        except (OSError, ValueError) as error:
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
                raise ConfigError(f"{file}: {key}: expected {_name(types_of[key])}, got {value!r:.200}")
        try:
            return cls(**content)
        except ConfigError as error:
            raise ConfigError(f"{file}: {error}") from None

    @property
    def host(self) -> str:
        """The listen address that ``server_url`` names."""
        host = self.server_url.partition("://")[2] or self.server_url
        host = host.rstrip("/")
        return DEFAULT_HOST if host == "localhost" else host

    @property
    def torch_dtype(self) -> torch.dtype | None:
        """The torch type that ``dtype`` names; None: ``dtype`` is not set."""
        import torch  # imported here: few readers of a configuration need torch

        return getattr(torch, self.dtype) if self.dtype else None

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can reach it."""
        return is_loopback(self.host)


def _at_least(least: int, config: ServeConfig, *keys: str) -> None:
    for key in keys:
        value = getattr(config, key)
        if value is not None and value < least:
            raise ConfigError(f"{key}: expected at least {least}, got {value}")


def _at_most(most: int, config: ServeConfig, *keys: str) -> None:
    for key in keys:
        value = getattr(config, key)
        if value is not None and value > most:
            raise ConfigError(f"{key}: expected at most {most}, got {value}")


def _fits(value: Any, expected: Any) -> bool:
    if isinstance(expected, types.UnionType):
        return any(_fits(value, kind) for kind in typing.get_args(expected))
    return type(value) is expected  # not isinstance: True is no number of GPUs


def _name(expected: Any) -> str:
    if isinstance(expected, types.UnionType):
        return " or ".join(_name(kind) for kind in typing.get_args(expected))
    return "null" if expected is type(None) else str(expected.__name__)
