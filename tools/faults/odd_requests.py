# SPDX-License-Identifier: MIT
"""Requests as they should not be: odd tensors, odd documents, and bytes with mistakes."""

from __future__ import annotations

import json
import random
import re
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from tritonclient.grpc import service_pb2 as pb

from rfm_client import PreferenceSample, ProgressSample, Sample, Trajectory
from rfm_client.contract import wire

DIMS = (48, 32)  # widths of its embeddings
Inputs = Mapping[str, np.ndarray[Any, Any]]
_DATATYPES = {"uint8": "UINT8", "int32": "INT32", "float32": "FP32", "object": "BYTES"}


_ODD_NUMBERS = (-(2**63), -(2**31), -1, 0, 1, 2, 255, 4096, 2**31 - 1, 2**31, 2**32, 2**63, 1e308, 10**40)


_ODD_VALUES = (
    None,
    True,
    "",
    "x",
    "\0",
    "\ud800",
    "9" * 400,
    [],
    {},
    [[]],
    [None],
    {"a": {}},
    float("nan"),
    float("inf"),
)


def samples() -> list[Sample]:
    """One of each kind."""
    numbers = np.random.default_rng(0)

    def embedded(frames: int) -> Trajectory:
        video = numbers.standard_normal((frames, DIMS[0]), np.float32)
        return Trajectory(video_embeddings=video, text_embedding=numbers.standard_normal(DIMS[1], np.float32))

    filmed = Trajectory(frames=numbers.integers(0, 256, (2, 24, 24, 3), np.uint8), task="stack the cups")
    return [
        ProgressSample(embedded(4)),
        ProgressSample(embedded(5), frame_steps=2),
        PreferenceSample(embedded(2), embedded(3)),
        ProgressSample(filmed),
        PreferenceSample(filmed, filmed),
    ]


def odd_inputs(choose: random.Random) -> tuple[str, dict[str, np.ndarray[Any, Any]]]:
    """Model and inputs of one sample, one of which holds something else: what model.py must judge."""
    sample = choose.choice(samples())
    inputs = dict(wire.encode_samples([sample]))
    model = "rfm_frames" if wire.FRAMES in inputs else "rfm"
    name = choose.choice(list(inputs))
    array = inputs[name].copy()
    if name == wire.TASK:
        array[0, 0] = choose.choice([b"", b" ", b"\xff\xfe", b"\0", b"[SEP]" * 3, b"cup " * 3000, choose.randbytes(30)])
    elif array.dtype == np.float32:
        array.flat[choose.randrange(array.size)] = choose.choice([np.nan, np.inf, -np.inf, 3e38, 1e-45, 1e30])
    elif name == wire.FRAMES:
        array = array[:, :, : choose.choice([0, 1, 24]), : choose.choice([0, 1, 24])]
    else:
        most = np.iinfo(array.dtype)
        array.flat[choose.randrange(array.size)] = choose.choice([most.min, most.max, 0, 1, 2, 3, 7, 5000 % most.max])
    if choose.random() < 0.3 and array.dtype != object:
        array = array[:, : choose.randrange(array.shape[1] + 1)]
    return model, {**inputs, name: array}


def mutated(content: bytes, choose: random.Random) -> bytes:
    """The bytes with a few changes."""
    changed = bytearray(content)
    for _ in range(choose.choice((1, 1, 2, 4, 8))):
        at = choose.randrange(len(changed) + 1)
        kind = choose.randrange(6)
        if kind == 0 and at < len(changed):
            changed[at] ^= 1 << choose.randrange(8)
        elif kind == 1:
            changed[at:at] = choose.randbytes(choose.choice((1, 2, 8, 64)))
        elif kind == 2:
            del changed[at : at + choose.choice((1, 2, 8, 200))]
        elif kind == 3:
            changed[at:at] = changed[at : at + choose.randrange(1, 100)]
        elif kind == 4:
            numbers = list(re.finditer(rb"-?\d+", bytes(changed)))
            if numbers:
                number = choose.choice(numbers)
                changed[number.start() : number.end()] = str(choose.choice(_ODD_NUMBERS)).encode()
        else:
            del changed[at + choose.randrange(40) :]
    return bytes(changed)


def odd(document: Any, choose: random.Random) -> bytes:
    """JSON in which one value, anywhere, is another, is missing, or has a neighbour."""
    document = json.loads(json.dumps(document))
    at = document
    while True:
        key = choose.choice(list(at) if isinstance(at, dict) else range(len(at)))
        if isinstance(at[key], (dict, list)) and at[key] and choose.random() < 0.75:
            at = at[key]
            continue
        if choose.random() < 0.2:
            del at[key]
        else:
            at[key] = choose.choice([*_ODD_VALUES, *_ODD_NUMBERS])
        return json.dumps(document).encode()


def post(path: str, body: bytes, content_type: str = "application/json", **headers: str) -> bytes:
    """An HTTP request."""
    told = {"Host": "localhost", "Content-Type": content_type, "Content-Length": str(len(body)), **headers}
    lines = "".join(f"{name}: {value}\r\n" for name, value in told.items())
    return f"POST {path} HTTP/1.1\r\n{lines}\r\n".encode() + body


def in_json(inputs: Inputs) -> bytes:
    """As the KServe protocol has it."""
    tensors = [
        {
            "name": name,
            "shape": list(array.shape),
            "datatype": _DATATYPES[array.dtype.name],
            "data": [item.decode(errors="replace") for item in array.flat]
            if array.dtype == object
            else array.ravel().tolist(),
        }
        for name, array in inputs.items()
    ]
    return json.dumps({"inputs": tensors}).encode()


def raw(array: np.ndarray[Any, Any]) -> bytes:
    """A tensor's bytes as Triton reads them."""
    if array.dtype == object:
        return b"".join(struct.pack("<I", len(item)) + item for item in array.flat)
    return array.tobytes()


def in_binary(inputs: Inputs) -> tuple[bytes, dict[str, str]]:
    """Body and header of Triton's binary extension."""
    tensors, contents = [], [raw(array) for array in inputs.values()]
    for (name, array), content in zip(inputs.items(), contents, strict=True):
        size = {"binary_data_size": len(content)}
        tensors.append(
            {"name": name, "shape": list(array.shape), "datatype": _DATATYPES[array.dtype.name], "parameters": size}
        )
    told = json.dumps({"inputs": tensors}).encode()
    return told + b"".join(contents), {"Inference-Header-Content-Length": str(len(told))}


def in_protobuf(model: str, inputs: Inputs) -> bytes:
    """As the gRPC service has it."""
    request = pb.ModelInferRequest(model_name=model)
    for name, array in inputs.items():
        request.inputs.add(name=name, datatype=_DATATYPES[array.dtype.name], shape=array.shape)
        request.raw_input_contents.append(raw(array))
    return bytes(request.SerializeToString())
