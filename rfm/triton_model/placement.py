# SPDX-License-Identifier: MIT
"""Device and CPU threads of a model instance."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import torch

from rfm.engine.device import use
from rfm.engine.layers import keep_float32
from rfm.engine.threads import num_preparing, use_threads
from rfm.parameters import THREADS_PARAMETER


@dataclass(frozen=True)
class Placement:
    """Device of the network, and number of PyTorch's CPU threads."""

    device: torch.device
    num_threads: int

    @property
    def num_preparing(self) -> int:
        """Number of requests that are prepared at the same time."""
        return num_preparing(self.device, self.num_threads)

    @classmethod
    def of(cls, args: Mapping[str, str], config: Mapping[str, Any], settings: Mapping[str, str]) -> Placement:
        """Return an instance's placement, from the arguments of ``initialize``. Instances share the machine's cores."""
        on_gpu = args["model_instance_kind"] == "GPU"
        num_threads = int(settings[THREADS_PARAMETER]) or max(torch.get_num_threads() // num_instances(config), 1)
        device = torch.device("cuda", int(args["model_instance_device_id"])) if on_gpu else torch.device("cpu")
        return cls(device, num_threads)

    def apply(self) -> None:
        """Apply the settings to the calling thread. Every computing thread must call it."""
        use_threads(self.num_threads)
        keep_float32()
        use(self.device)

    def run(self, work: Callable[[], None]) -> None:
        """Do the work in a temporary thread, whose OpenMP threads end with it."""
        use_threads(1)  # for the calling thread
        with ThreadPoolExecutor(1, "rfm-load") as thread:
            thread.submit(self.apply).result()
            thread.submit(work).result()


def num_instances(config: Mapping[str, Any]) -> int:
    """Return the number of a model's instances on all devices. config: the model's configuration from Triton"""
    return sum(group["count"] * max(len(group.get("gpus", [])), 1) for group in config["instance_group"])
