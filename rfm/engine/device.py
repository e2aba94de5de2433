# SPDX-License-Identifier: MIT
"""Devices: memory, streams, the current device, out-of-memory errors, and what decides a score's last digits.

PyTorch chooses the kernel for ``scaled_dot_product_attention`` by its version, the GPU, the dtype and the shapes.
``tests/support/pretended.py`` replaces CUDA functions, so tests run the same code without a GPU.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

_CPU_OUT_OF_MEMORY = re.compile(  # PyTorch's allocator and oneDNN (which gives no reason) raise plain RuntimeErrors
    r"DefaultCPUAllocator: can't allocate memory|could not (create|execute) a (primitive|memory object)"
)


@contextmanager
def memory_errors() -> Iterator[None]:
    """Turn out-of-memory errors, from Python or from PyTorch on the CPU, into torch.OutOfMemoryError."""
    try:
        yield
    except MemoryError as error:
        raise torch.OutOfMemoryError(str(error)) from error
    except RuntimeError as error:
        if not _CPU_OUT_OF_MEMORY.search(str(error)):
            raise
        raise torch.OutOfMemoryError(str(error)) from error


def use(device: torch.device) -> None:
    """Make ``device`` the current device for this thread.

    Call this in each computing thread: some kernels launch on the current device, wherever the tensors are.
    """
    if device.type == "cuda":
        torch.cuda.set_device(device)


class Copies:
    """Copies to a GPU from pinned memory, on a separate stream, while the GPU computes. On the CPU they do nothing."""

    def __init__(self, device: torch.device) -> None:
        self.pins = device.type == "cuda"
        self._stream = torch.cuda.Stream(device) if self.pins else None

    def send(self, pixels: Tensor) -> Tensor:
        """Start copying the pixels to the device, and return the copy; thread-safe."""
        if self._stream is None:
            return pixels
        with torch.cuda.stream(self._stream):  # PyTorch keeps the pinned copy until this stream has read it
            return pixels.pin_memory().to(self._stream.device, non_blocking=True)

    def wait_for(self, pixels: Iterable[Tensor]) -> None:
        """Make the current stream, not the host, wait for all copies started so far.

        pixels: copies that the current stream reads; PyTorch does not reuse their memory before that
        """
        if self._stream is None:
            return
        current = torch.cuda.current_stream(self._stream.device)
        current.wait_stream(self._stream)
        for each in pixels:
            each.record_stream(current)


TORCH = f"torch {torch.__version__}"
ATTENTION = "scaled_dot_product_attention"


def computation(checkpoint: Any, dtype: torch.dtype | None, *, on_gpu: bool) -> str:
    """Return number type, PyTorch version and attention as one line.

    dtype: network dtype; None: float32 on the CPU, otherwise the checkpoint's own
    """
    if dtype is None:
        dtype = getattr(checkpoint.config, "torch_dtype", torch.float32) if on_gpu else torch.float32
    return f"{str(dtype).removeprefix('torch.')}, {TORCH}, {ATTENTION}"
