# SPDX-License-Identifier: MIT
"""Pixels on their way to a GPU while it computes: from pinned memory, on a stream of their own."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor


class Upload:
    """Copies to a device. On the CPU it does nothing."""

    def __init__(self, device: torch.device) -> None:
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None

    def __call__(self, pixels: Tensor) -> Tensor:
        """The pixels on the device, or on their way there; may be called in any thread."""
        if self._stream is None:
            return pixels
        with torch.cuda.stream(self._stream):  # PyTorch keeps the pinned copy until this stream has read it
            return pixels.pin_memory().to(self._stream.device, non_blocking=True)

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
