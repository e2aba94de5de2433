# SPDX-License-Identifier: MIT
"""Samples as the input file of Triton's ``perf_analyzer``, so that it measures real requests of mixed lengths.

The format is that of its ``--input-data`` (docs/input_data.md in triton-inference-server/perf_analyzer): under
``data`` one entry a request, each tensor as ``content`` in row-major order and ``shape`` without the batch axis,
which perf_analyzer adds. Numbers are written as base64 of their little-endian bytes: exact, and a third the size.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client.contract.samples import Sample
from rfm_client.contract.wire import encode_samples


def perf_analyzer_input(samples: Sequence[Sample]) -> dict[str, Any]:
    """The document: a request a sample, as RewardClient would send it alone."""
    requests = [encode_samples([sample]) for sample in samples]
    return {"data": [{name: _tensor(array[0]) for name, array in request.items()} for request in requests]}


def write_perf_analyzer_input(file: Path, samples: Sequence[Sample]) -> None:
    """Writes the samples to ``file``, in perf_analyzer's JSON format."""
    file.write_text(json.dumps(perf_analyzer_input(samples)))


def _tensor(array: npt.NDArray[Any]) -> dict[str, Any]:
    if array.dtype == np.object_:  # BYTES: text, as it is
        return {"content": [element.decode() for element in array.ravel()], "shape": list(array.shape)}
    little_endian = array.astype(array.dtype.newbyteorder("<"), copy=False)
    return {"content": {"b64": base64.b64encode(little_endian.tobytes()).decode()}, "shape": list(array.shape)}
