# SPDX-License-Identifier: MIT
"""A short name for the inputs of a request."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm.journal import DIGEST_BYTES

_SAMPLED_BYTES = 2**14  # of each tensor: a digest shall cost microseconds, whatever the size
_BLOCK_BYTES = 2**9


def digest(tensors: Mapping[str, npt.NDArray[Any]]) -> bytes:
    """A digest of a request's inputs, 8 bytes.

    Of a large tensor it covers the shape and an even sample of the content.
    """
    content_hash = hashlib.sha1(usedforsecurity=False)
    for name in sorted(tensors):
        array = tensors[name]
        content_hash.update(f"{name}{array.shape}".encode())
        content_hash.update(_sampled(array))
    return content_hash.digest()[:DIGEST_BYTES]


def _sampled(array: npt.NDArray[Any]) -> bytes | memoryview:
    """The content, or blocks of it at even distances."""
    if array.dtype == np.object_:
        return b"\0".join(bytes(item) for item in array.ravel())
    flat = array.ravel()
    if flat.nbytes <= _SAMPLED_BYTES:
        return flat.data
    content = flat.view(np.uint8)
    blocks = content[-(content.nbytes // _BLOCK_BYTES) * _BLOCK_BYTES :].reshape(-1, _BLOCK_BYTES)
    step = -(-len(blocks) * _BLOCK_BYTES // _SAMPLED_BYTES)
    return np.ascontiguousarray(blocks[::step]).data
