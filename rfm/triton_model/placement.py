# SPDX-License-Identifier: MIT
"""On which device, and with how many CPU threads, an instance of a model computes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import torch

from rfm.engine.device import use
from rfm.engine.layers import keep_float32
from rfm.parameters import THREADS_PARAMETER


@dataclass(frozen=True)
class Placement:
    """device: of the network; num_threads: of PyTorch on the CPU"""

    device: torch.device
    num_threads: int

    @property
    def num_preparing(self) -> int:
        """Threads that prepare samples beside the scoring, which needs the CPU itself unless it is on a GPU."""
        return self.num_threads if self.device.type == "cuda" else 1

    @classmethod
    def of(cls, args: Mapping[str, str], config: Mapping[str, Any], settings: Mapping[str, str]) -> Placement:
        """Where Triton places an instance; ``args`` of ``initialize``. All instances share the machine's cores."""
        on_gpu = args["model_instance_kind"] == "GPU"
        num_threads = int(settings[THREADS_PARAMETER]) or max(torch.get_num_threads() // num_instances(config), 1)
        device = torch.device("cuda", int(args["model_instance_device_id"])) if on_gpu else torch.device("cpu")
        return cls(device, num_threads)

    def apply(self) -> None:
        """To be called in each thread that computes: both settings are a thread's own."""
        use_threads(self.num_threads)
        keep_float32()
        use(self.device)

    def run(self, work: Callable[[], None]) -> None:
        """Does the work in a thread of its own. When that ends, its OpenMP threads end, too."""
        use_threads(1)  # in the thread that calls
        with ThreadPoolExecutor(1, "rfm-load") as thread:
            thread.submit(self.apply).result()
            thread.submit(work).result()


def use_threads(number: int) -> None:
    """Has PyTorch compute with so many threads in the calling thread."""
    torch.get_num_threads()  # at first it takes over what any thread has set last, even after ``set_num_threads``
    torch.set_num_threads(number)


def num_instances(config: Mapping[str, Any]) -> int:
    """Instances of a model, on all its devices; ``config``: its configuration as Triton gives it."""
    return sum(group["count"] * max(len(group.get("gpus", [])), 1) for group in config["instance_group"])
