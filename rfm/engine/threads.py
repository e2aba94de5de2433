# SPDX-License-Identifier: MIT
"""PyTorch's threads, and the threads that prepare frames for a GPU.

Pillow, PyTorch and hashlib release the GIL, so threads resize, compress and hash frames at the same time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TypeVar

import torch

Item = TypeVar("Item")
Made = TypeVar("Made")


def use_threads(number: int) -> None:
    """Set PyTorch's thread count for the calling thread."""
    torch.get_num_threads()  # otherwise the first use takes another thread's count
    torch.set_num_threads(number)


def num_preparing(device: torch.device, num_threads: int) -> int:
    """Return how many instance threads prepare frames while the network computes: all with a GPU, otherwise 1."""
    return num_threads if device.type == "cuda" else 1


class FrameThreads:
    """Threads that prepare frames. Any thread may call ``parts``, and waits for the result.

    number: thread count; 1: the calling thread does the work
    """

    def __init__(self, number: int) -> None:
        self.number = number
        # Work must not itself wait for these threads. They end with this object.
        self._pool = ThreadPoolExecutor(number, "rfm-frames", partial(use_threads, 1)) if number > 1 else None

    @classmethod
    def of(cls, device: torch.device) -> FrameThreads:
        """Return the threads for a network on ``device``, created in a thread that has the instance's thread count."""
        return cls(num_preparing(device, torch.get_num_threads()))

    def parts(self, work: Callable[[Sequence[Item]], Made], items: Sequence[Item]) -> list[Made]:
        """Split items into one part per thread; return the results of ``work`` in order."""
        if self._pool is None or len(items) < 2:
            return [work(items)]
        size = -(-len(items) // self.number)
        return list(self._pool.map(work, [items[start : start + size] for start in range(0, len(items), size)]))


IN_TURN = FrameThreads(1)  # one frame after the other
