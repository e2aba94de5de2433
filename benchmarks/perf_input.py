# SPDX-License-Identifier: MIT
"""Write synthetic samples as input for Triton's perf_analyzer, and print a command that sends them.

    python benchmarks/perf_input.py --output requests.json --num-frames 4 8 16

The file follows perf_analyzer's ``--input-data`` format (its docs/input_data.md). ``data`` has an entry for each
request. Each tensor has ``content`` in row-major order, and ``shape`` without the batch axis, which perf_analyzer adds.
Numbers are base64 of their little-endian bytes.
"""

from __future__ import annotations

import argparse
import base64
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import numpy.typing as npt

from rfm_client import RewardClient, Sample
from rfm_client.cli.options import SampleType, SyntheticSamples
from rfm_client.contract.wire import DEFAULT_MODEL, encode_samples, frames_name


def main() -> None:
    """Ask the server for the model's widths, write the file, and print the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--url", default="grpc://localhost:8001", help="a server that runs")
    parser.add_argument("--model", default=DEFAULT_MODEL)
    parser.add_argument("--sample-type", default="progress", choices=get_args(SampleType))
    parser.add_argument("--num-samples", type=int, default=64, help="for each length")
    parser.add_argument("--num-frames", type=int, nargs="+", default=[8], help="lengths of trajectories")
    parser.add_argument("--use-frames", action="store_true", help="raw frames even if the model takes embeddings")
    given = parser.parse_args()
    samples: list[Sample] = []
    with RewardClient(given.url, model=given.model) as client:
        for length in given.num_frames:
            samples += SyntheticSamples(given.sample_type, given.num_samples, length, given.use_frames).samples(client)
    write(given.output, samples)
    scheme, _, address = given.url.partition("://")
    are_frames = samples[0].trajectories[0].frames is not None
    name = frames_name(given.model) if are_frames else given.model
    words = [
        "perf_analyzer",
        "-m",
        name,
        "-i",
        scheme.removesuffix("s"),
        "-u",
        address,
        "--input-data",
        str(given.output),
    ]
    print(shlex.join([*words, "--async", "--concurrency-range", "1:16:5"]))


def write(file: Path, samples: Sequence[Sample]) -> None:
    """Write for each sample the request that RewardClient would send for it alone."""
    requests = [encode_samples([sample]) for sample in samples]
    data = [{name: _tensor(array[0]) for name, array in request.items()} for request in requests]
    file.write_text(json.dumps({"data": data}))


def _tensor(array: npt.NDArray[Any]) -> dict[str, Any]:
    if array.dtype == np.object_:  # BYTES: plain text
        return {"content": [element.decode() for element in array.ravel()], "shape": list(array.shape)}
    little_endian = array.astype(array.dtype.newbyteorder("<"), copy=False)
    return {"content": {"b64": base64.b64encode(little_endian.tobytes()).decode()}, "shape": list(array.shape)}


if __name__ == "__main__":
    main()
