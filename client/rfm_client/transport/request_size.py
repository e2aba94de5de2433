# SPDX-License-Identifier: MIT
"""The largest request that can be sent, checked before a copy is made."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.wire import Tensors

MAX_REQUEST_BYTES = 2**31 - 2**16  # gRPC and Triton's HTTP server count a message's bytes in 32 bits; rest: headers
_BYTES_PER_GB = 1e9
_LENGTH_BYTES = 4  # before each text


def check_size(inputs: Tensors, shared: Collection[str]) -> None:
    """Raise InvalidSampleError if the inputs outside of shared memory do not fit into one request.

    shared: names of the inputs in shared memory
    """
    sizes = {name: _num_bytes(inputs, name) for name in inputs if name not in shared}
    if sum(sizes.values()) <= MAX_REQUEST_BYTES:
        return
    raise InvalidSampleError.at(
        max(sizes, key=lambda name: sizes[name]),
        f"at most {MAX_REQUEST_BYTES / _BYTES_PER_GB:.2f} GB in a request",
        f"{sum(sizes.values()) / _BYTES_PER_GB:.2f} GB",
        "shrink the frames (resize, --resize), score fewer (subsample, --max-frames), or share memory with a server on "
        "this host (shared_memory)",
    )


def _num_bytes(inputs: Tensors, name: str) -> int:
    array = inputs[name]
    if array.dtype != np.object_:
        return array.nbytes
    return sum(len(text) + _LENGTH_BYTES for text in array.ravel())
