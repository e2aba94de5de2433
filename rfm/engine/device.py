# SPDX-License-Identifier: MIT
"""All that is CUDA's own: no other module asks for it. On the CPU, nothing of it is done.

``tests/support/pretended.py`` has a twin, with which the same code runs on a device that PyTorch pretends to have.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

_CPU_OUT_OF_MEMORY = re.compile(  # PyTorch's allocator and oneDNN, which gives no reason, raise plain RuntimeErrors
    r"DefaultCPUAllocator: can't allocate memory|could not (create|execute) a (primitive|memory object)"
)


@contextmanager
def memory_errors() -> Iterator[None]:
    """A context in which every lack of memory is a torch.OutOfMemoryError: a GPU's, PyTorch's on the CPU, Python's."""
    try:
        yield
    except MemoryError as error:
        raise torch.OutOfMemoryError(str(error)) from error
    except RuntimeError as error:
        if not _CPU_OUT_OF_MEMORY.search(str(error)):
            raise
        raise torch.OutOfMemoryError(str(error)) from error


def free_unused() -> None:
    """Gives back the memory that PyTorch keeps for later; nothing where there is no GPU."""
    torch.cuda.empty_cache()


def use(device: torch.device) -> None:
    """To be called in each thread that computes: some kernels launch on the current device, whatever their tensors'."""
    if device.type == "cuda":
        torch.cuda.set_device(device)


def pinned(tensor: Tensor) -> Tensor:
    """The tensor in memory from which a GPU copies while the host goes on."""
    return tensor.pin_memory()


class Copies:
    """Copies to a GPU while it computes: from pinned memory, on a stream of their own. On the CPU they do nothing."""

    def __init__(self, device: torch.device) -> None:
        self.pins = device.type == "cuda"
        self._stream = torch.cuda.Stream(device) if self.pins else None

    def send(self, pixels: Tensor) -> Tensor:
        """The pixels on the device, or on their way there; may be called in any thread."""
        if self._stream is None:
            return pixels
        with torch.cuda.stream(self._stream):  # PyTorch keeps the pinned copy until this stream has read it
            return pinned(pixels).to(self._stream.device, non_blocking=True)

    def wait_for(self, pixels: Iterable[Tensor]) -> None:
        """Has the current stream, not the host, wait until all pixels that were sent so far have arrived.

        pixels: what the current stream reads; their memory is not used again before it has
        """
        if self._stream is None:
            return
        current = torch.cuda.current_stream(self._stream.device)
        current.wait_stream(self._stream)
        for each in pixels:
            each.record_stream(current)
