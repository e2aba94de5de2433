# SPDX-License-Identifier: MIT
"""Start a model process: protect shared memory, check weights, choose the instance's device and CPU threads."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from google.protobuf import text_format
from tritonclient.grpc import model_config_pb2 as pb

from rfm.engine.device import use
from rfm.engine.layers import keep_float32
from rfm.engine.threads import use_threads
from rfm.files import CheckpointError, is_there, weights_digest
from rfm.parameters import THREADS_PARAMETER
from rfm_client.contract.description import DESCRIPTION_PARAMETER, Description, num_instances

_REGION = re.compile(r"/dev/shm/[^/\s]+$", re.MULTILINE)


@dataclass(frozen=True)
class Placement:
    """Device for the network, and PyTorch's CPU thread count."""

    device: torch.device
    num_threads: int

    @classmethod
    def of(cls, args: Mapping[str, str], config: Mapping[str, Any], settings: Mapping[str, str]) -> Placement:
        """Return an instance's placement, from the arguments of ``initialize``. Instances share the machine's cores."""
        on_gpu = args["model_instance_kind"] == "GPU"
        num_threads = int(settings[THREADS_PARAMETER]) or max(torch.get_num_threads() // num_instances(config), 1)
        device = torch.device("cuda", int(args["model_instance_device_id"])) if on_gpu else torch.device("cpu")
        return cls(device, num_threads)

    def apply(self) -> None:
        """Apply the settings to the calling thread. Every computing thread must call this."""
        use_threads(self.num_threads)
        keep_float32()
        use(self.device)

    def run(self, work: Callable[[], None]) -> None:
        """Do the work in a temporary thread, so that its OpenMP threads end with it."""
        use_threads(1)  # for the calling thread
        with ThreadPoolExecutor(1, "rfm-load") as thread:
            thread.submit(self.apply).result()
            thread.submit(work).result()


def close_to_other_users() -> None:
    """Set this process's shared memory to mode 0600. Triton creates it with 0644, whatever the umask says."""
    for region in {*_REGION.findall(Path("/proc/self/maps").read_text())}:
        with suppress(OSError):  # another user's
            Path(region).chmod(0o600)


def check_digest(version: Path, expected: str | None) -> None:
    """Raise CheckpointError if the weights in the folder ``version`` changed after the export.

    expected: digest in the model's configuration; None: unknown. The configuration in the version folder takes
        precedence, because the model's may belong to a newer version
    """
    kept = version / "config.pbtxt"
    if is_there(kept):
        try:
            config = text_format.Parse(kept.read_text(), pb.ModelConfig())
            expected = Description.parse(config.parameters[DESCRIPTION_PARAMETER].string_value).weights_digest
        except (OSError, ValueError, text_format.ParseError) as error:
            raise CheckpointError.at(kept, "a configuration of the export", error, "export again") from error
    if expected and (got := weights_digest([version])) != expected:
        raise CheckpointError.at(
            version, f"the weights that were exported ({expected})", f"others ({got})", "export them again"
        )
