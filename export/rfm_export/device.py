# SPDX-License-Identifier: MIT
"""Where an export is compared with its checkpoint: on a GPU with room for it, or on the CPU."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from rfm.family import NETWORK, Checkpoint
from rfm_export.errors import ExportError

WORKING_ROOM = 1.5  # of the weights' bytes: they, and what a pass over a few small samples needs
CPU = torch.device("cpu")


def device_for(checkpoint: Checkpoint, dtype: torch.dtype | None, *, may_use_gpu: bool) -> torch.device:
    """Where to compare, if nobody says: the CPU, and for a large network the GPU with most room, if that is enough.

    dtype: of the network there; None: the weights' own
    """
    if not (checkpoint.description.is_large and may_use_gpu and torch.cuda.is_available()):
        return CPU
    free_bytes = [_free_bytes(index) for index in range(torch.cuda.device_count())]
    weights = checkpoint.parts[NETWORK].values()
    needed = WORKING_ROOM * sum(each.numel() * (dtype or each.dtype).itemsize for each in weights)
    roomiest = max(range(len(free_bytes)), key=free_bytes.__getitem__)
    return torch.device("cuda", roomiest) if free_bytes[roomiest] >= needed else CPU


def _free_bytes(index: int) -> int:
    try:
        return torch.cuda.mem_get_info(index)[0]
    except RuntimeError:  # it is too full to be asked, or belongs to another process alone
        return 0


def device_named(name: str) -> torch.device:
    """The device of this name. Raises ExportError for one that this machine has not."""
    there = ["cpu", "cuda", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
    there = there if torch.cuda.is_available() else there[:1]
    if name not in there:
        why = "" if torch.cuda.is_available() else f": PyTorch {torch.__version__} finds no GPU; --device cpu"
        raise ExportError(f"device: expected one of {', '.join(there)}, got {name}{why}")
    return torch.device(name)


@contextmanager
def needing_room(device: torch.device) -> Iterator[None]:
    """Raises ExportError for a network that does not fit on the device."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        reason = str(error).partition("\n")[0].partition(". ")[0]
        expected = f"room on {device} to compare the export with the checkpoint"
        raise ExportError(f"device: expected {expected}, got: {reason}; --device names another one") from error
