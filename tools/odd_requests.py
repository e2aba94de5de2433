# SPDX-License-Identifier: MIT
"""Malformed requests for ``make chaos``. Servers must survive them and still answer other callers."""

from __future__ import annotations

import random
import subprocess
import sys
from collections import Counter
from pathlib import Path

import grpc
import numpy as np
from tritonclient.grpc import service_pb2

from rfm_client import PreferenceSample, ProgressSample, Trajectory
from rfm_client.contract import wire
from trajectories import random_trajectory

SCHEMATHESIS = Path(sys.executable).parent / "schemathesis"
DEADLINE_S = 20.0
DATATYPES = {"uint8": "UINT8", "int32": "INT32", "float32": "FP32", "object": "BYTES"}


def against_gateway(url: str, examples: int, seed: int) -> bool:
    """Send requests that schemathesis derives from the OpenAPI document. Returns False for a 5xx or a late answer."""
    options = ["--phases=coverage,fuzzing", f"--max-examples={examples}", f"--seed={seed}", "--no-color"]
    options += ["--checks=not_a_server_error", f"--request-timeout={DEADLINE_S:g}", "--continue-on-failure"]
    return subprocess.run([SCHEMATHESIS, "run", f"{url}/openapi.json", *options]).returncode == 0


def messages(widths: tuple[int, int]) -> list[bytes]:
    """Return valid gRPC requests: progress from embeddings, a preference, and progress from frames."""
    frames = np.random.default_rng(0).integers(0, 256, (2, 24, 24, 3), np.uint8)
    first, second = random_trajectory(0, 4, *widths), random_trajectory(1, 5, *widths)
    filmed = Trajectory(frames=frames, task="stack the cups")
    made = []
    for sample in (ProgressSample(first), PreferenceSample(first, second), ProgressSample(filmed)):
        inputs = wire.encode_samples([sample])
        request = service_pb2.ModelInferRequest(model_name="rfm_frames" if wire.FRAMES in inputs else "rfm")
        for name, array in inputs.items():
            request.inputs.add(name=name, datatype=DATATYPES[array.dtype.name], shape=array.shape)
            words = [len(word).to_bytes(4, "little") + word for word in array.flat] if array.dtype == object else []
            request.raw_input_contents.append(b"".join(words) or array.tobytes())
        made.append(request.SerializeToString())
    return made


def spoilt(message: bytes, choose: random.Random) -> bytes:
    """Corrupt the message: change, add or remove some bytes."""
    changed = bytearray(message)
    for _ in range(choose.choice((1, 2, 8))):
        at, length = choose.randrange(len(changed)), choose.choice((0, 1, 8, 64))
        changed[at : at + length] = choose.randbytes(choose.choice((0, 1, 8)))
    return bytes(changed)


def against_triton(url: str, widths: tuple[int, int], count: int, seed: int) -> Counter[str]:
    """Send ``count`` corrupted messages and count the status codes. tests/families has valid but odd tensors."""
    choose, codes, whole = random.Random(seed), Counter[str](), messages(widths)
    with grpc.insecure_channel(url.removeprefix("grpc://")) as channel:
        call = channel.unary_unary("/inference.GRPCInferenceService/ModelInfer")
        for number in range(count):
            try:
                call(spoilt(whole[number % len(whole)], choose), timeout=DEADLINE_S)
                codes["OK"] += 1
            except grpc.RpcError as error:
                codes[error.code().name] += 1
    return codes
