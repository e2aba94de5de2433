# SPDX-License-Identifier: MIT
"""The settings of an export and a server: the sections ``export`` and ``serve`` in one YAML file.

``rfm_commands.config`` reads this file.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, TypeAlias

from rfm.parameters import DEFAULT_HANG_S
from rfm_client.contract.addresses import MAX_PORT, is_loopback
from rfm_client.contract.checks import require
from rfm_client.contract.settings import ConfigError, Settings, setting
from rfm_client.contract.wire import DEFAULT_MODEL

if TYPE_CHECKING:
    import torch

__all__ = ["CheckpointConfig", "ExportConfig", "ServeConfig", "address_of"]

DEFAULT_HOST = "127.0.0.1"
DEFAULT_TOKEN_BUDGET = 16_384
DEFAULT_SAMPLE_TOKENS = 131_072
DEFAULT_FEATURE_CACHE_MB = 256  # 80,000 embeddings with 768 numbers, or 170 frames at 256x256 for a 4B Qwen3-VL
MAX_PER_MACHINE = 4096  # GPUs, instances, threads
MAX_INT32 = 2**31 - 1
MAX_NAME = 100  # characters; a model's name becomes a folder name
Dtype: TypeAlias = Literal["float32", "bfloat16", "float16"]
VideoPrompt: TypeAlias = Literal["bare", "wrapped"]
Weights: TypeAlias = Literal["int8", "nf4"]

_COUNT = {"least": 1, "most": MAX_INT32}
_PORT = {"least": 1, "most": MAX_PORT}
_PER_MACHINE = {"most": MAX_PER_MACHINE}
_OR_MOVED = ", or 20 more while another setting names that port."


@dataclass(frozen=True)
class CheckpointConfig(Settings):
    """A checkpoint, how it is asked, and its number formats."""

    TITLE: ClassVar[str] = "Checkpoint"

    checkpoint: str | None = setting(None, "Folder, or Hugging Face id org/name[/subfolder][@tag].")
    image_encoder: str | None = setting(None, "Folder or id of ReWiND's image encoder.")
    text_encoder: str | None = setting(None, "Folder or id of ReWiND's text encoder.")
    base_model: str | None = setting(
        None, "Folder or id of a vision-language checkpoint's base model. Default: as the checkpoint says."
    )
    reward_model: str | None = setting(
        None,
        "How to ask a model that has no config.yaml: topreward, topreward-robometer, roboreward, roboreward-expected "
        "or robodopamine; settings follow: topreward,num_prefixes=15.",
        flag="--as",
        metavar="NAME",
    )
    video_prompt: VideoPrompt | None = setting(
        None,
        "Video prompt of a Qwen3-VL: as before transformers 5.10 (bare), or since (wrapped). Default: by the "
        "checkpoint's transformers_version.",
    )
    strict_answers: bool = setting(
        False, "Refuse samples with an unclear RoboReward answer (1.5, 3/5, two scores) instead of marking them."
    )
    weights: Weights | None = setting(
        None,
        "Round the weights of a vision-language model to 8 bits (int8) or 4 bits (nf4), for GPUs of 8 or 12 GB. Scores "
        "are then not the full checkpoint's. Default: as in the checkpoint.",
    )
    robot_description: str | None = setting(None, "Words for the robot in RynnValue's prompt.")
    camera_description: str | None = setting(None, "Words for the camera in RynnValue's prompt.")
    dtype: Dtype | None = setting(None, "Number type of the network. Default: by checkpoint and device.")

    @property
    def torch_dtype(self) -> torch.dtype | None:
        """The torch type that ``dtype`` names; None: ``dtype`` is not set."""
        import torch  # imported here: few readers of a configuration need it

        return getattr(torch, self.dtype) if self.dtype else None


@dataclass(frozen=True)
class ExportConfig(CheckpointConfig):
    """The settings that ``rfm export`` writes into a repository. To change them, export again."""

    TITLE: ClassVar[str] = "Export"
    NO_OPTION: ClassVar[Collection[str]] = {"batch_size"}

    name: str = setting(DEFAULT_MODEL, "Model name in the repository. NAME_frames scores raw frames.")
    num_gpus: int | None = setting(
        None, "Number of GPUs; 0 means the CPU. Default: all GPUs, or the CPU.", least=0, **_PER_MACHINE
    )
    instances: int | None = setting(
        None,
        "Instances of each model per GPU, or on the CPU. Default: 2 per GPU for models of embeddings, else 1.",
        least=1,
        **_PER_MACHINE,
    )
    torch_threads: int = setting(
        0, "CPU threads per instance; 0 divides the cores among the instances.", least=0, **_PER_MACHINE
    )
    max_batch_size: int | None = setting(
        None, "Largest batch, over all callers. Default: enough to saturate a GPU, at most 64.", **_COUNT
    )
    token_budget: int = setting(
        DEFAULT_TOKEN_BUDGET, "Largest forward pass of several samples, in tokens with padding.", **_COUNT
    )
    max_sample_tokens: int = setting(
        DEFAULT_SAMPLE_TOKENS, "Largest sample, or longest prefix, in tokens. Bounds memory.", **_COUNT
    )
    max_queue_size: int | None = setting(
        None, "Most requests that wait for a model; others are rejected. Default: no limit.", **_COUNT
    )
    queue_timeout_ms: int | None = setting(
        None, "Longest wait of a request before it is rejected. Default: no limit.", **_COUNT
    )
    feature_cache_mib: int = setting(
        DEFAULT_FEATURE_CACHE_MB,
        "Cache of frame features on each device, in MiB; 0 turns it off.",
        least=0,
        most=MAX_INT32,
    )
    cuda_graphs: bool = setting(
        False,
        "Run single samples and small batches as CUDA graphs. Needs a GPU, and RFM or Robometer on a Qwen backbone or "
        "RoboReward's expected score.",
    )
    batch_size: int | None = setting(
        None, "Of no effect, as in the FastAPI server; max_batch_size bounds a batch.", least=1
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_-]*", self.name):
            raise ConfigError.at("name", "letters, digits, _ and -", f"{self.name!r:.200}")
        require("name", len(self.name) <= MAX_NAME, f"at most {MAX_NAME} characters", len(self.name), ConfigError)


@dataclass(frozen=True)
class ServeConfig(Settings):
    """The settings of ``rfm serve`` itself. To change them, restart it.

    ``host`` may be a URL; only its address is kept. ``Endpoints.of`` chooses Triton's ports where they are None.
    """

    TITLE: ClassVar[str] = "Triton and its watch"

    host: str = setting(DEFAULT_HOST, "IP address to listen on, 0.0.0.0 or :: for all of IPv4 or IPv6.")
    http_port: int | None = setting(None, f"Triton's HTTP port; else 8000{_OR_MOVED}", **_PORT)
    grpc_port: int | None = setting(None, f"Triton's gRPC port; else 8001{_OR_MOVED}", **_PORT)
    metrics_port: int | None = setting(None, f"Port of Triton's metrics; else 8002{_OR_MOVED}", **_PORT)
    status_port: int | None = setting(None, "Port of /live, /ready and /metrics of rfm serve.", **_PORT)
    http_threads: int | None = setting(
        None, "Threads for HTTP requests. Default: Triton's choice.", least=1, **_PER_MACHINE
    )
    probe_s: int = setting(2, "Seconds between two probes of a model.", **_COUNT)
    hang_s: int = setting(
        DEFAULT_HANG_S,
        "Restart Triton after N seconds without progress of a batch.",
        **_COUNT,
    )
    triton_silent_s: int = setting(10, "Restart a Triton or gateway that does not answer for N seconds.", **_COUNT)
    api_key_file: Path | None = setting(
        None, "File with the key that callers need to score: at the gateway, over gRPC and over HTTP."
    )
    grpc_certificate: Path | None = setting(
        None, "Serve gRPC with TLS and this certificate (PEM); HTTP then stays on 127.0.0.1."
    )
    grpc_key: Path | None = setting(None, "The certificate's key (PEM).")
    grpc_client_ca: Path | None = setting(None, "Require client certificates from these authorities (PEM) over gRPC.")
    grpc_any_client: bool = setting(
        False, "Beyond loopback, too, let clients without a certificate or key use gRPC with TLS."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "host", address_of(self.host))
        ConfigError.require_both(self, "grpc_certificate", "grpc_key")
        if self.grpc_client_ca is not None and self.grpc_certificate is None:
            raise ConfigError.of_two("grpc_client_ca", "needs", "grpc_certificate")
        if self.grpc_any_client and self.grpc_certificate is None:
            raise ConfigError.of_two("grpc_any_client", "needs", "grpc_certificate")

    @property
    def is_loopback(self) -> bool:
        """True if only this machine can reach the server."""
        return is_loopback(self.host)


def address_of(host: str) -> str:
    """Return the IP address that a host's URL or name contains. Raises ConfigError."""
    address = (host.partition("://")[2] or host).rstrip("/")
    if address == "localhost":
        return DEFAULT_HOST
    if address.startswith("[") and address.endswith("]"):
        address = address[1:-1]
    try:
        if "%" in address:  # an IPv6 zone, which Triton's HTTP server does not support
            raise ValueError
        return str(ipaddress.ip_address(address))
    except ValueError:  # Triton would read a name as 255.255.255.255
        expected = "an IP address without a port, such as 127.0.0.1, ::1, 0.0.0.0 or ::"
        raise ConfigError.at("host", expected, f"{address!r:.200}") from None
