# SPDX-License-Identifier: MIT
"""Arrays from uploaded .npy files, which are not trusted: no pickle, and no more memory than was uploaded."""

from __future__ import annotations

import math
from typing import Any, BinaryIO, Protocol

import numpy as np
import numpy.typing as npt

from rfm_client.data.inputs import BROKEN_NPY

_format: Any = np.lib.format  # numpy declares no types for it
_HEADERS = {(1, 0): _format.read_array_header_1_0, (2, 0): _format.read_array_header_2_0}


class Upload(Protocol):
    """A part of a multipart request, as starlette has it; size: of the file, in bytes."""

    file: BinaryIO
    size: int | None


def read_npy(upload: Upload) -> npt.NDArray[Any]:
    """The array of numbers in the file. Raises ValueError."""
    file = upload.file
    file.seek(0)
    try:
        version = _format.read_magic(file)
    except ValueError as error:
        raise ValueError(f"expected a .npy file, got {error}") from None
    if version not in _HEADERS:
        raise ValueError(f"expected a .npy file of version 1.0 or 2.0, got {version}")
    try:
        shape, is_fortran, dtype = _HEADERS[version](file)
    except BROKEN_NPY as error:
        raise ValueError(f"expected a .npy file, got a broken header: {error}") from None
    if dtype.kind not in "biuf":
        raise ValueError(f"expected a .npy file of numbers, got {dtype}")
    num_bytes = math.prod(shape) * dtype.itemsize
    uploaded = (upload.size or 0) - file.tell()
    if num_bytes != uploaded:
        raise ValueError(f"expected a .npy file of {num_bytes} bytes behind its header, got {uploaded}")
    if not num_bytes:
        return np.empty(shape, dtype)
    return np.frombuffer(file.read(num_bytes), dtype).reshape(shape, order="F" if is_fortran else "C")
