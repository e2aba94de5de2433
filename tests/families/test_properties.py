# SPDX-License-Identifier: MIT
"""Properties of any input, which hypothesis makes up and shrinks."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import goldens
from rfm import published
from rfm.config import CheckpointConfig
from rfm.families.rewind.checkpoint import RewindCheckpoint
from rfm.families.rewind.network import RewindTransformer
from rfm.files import CheckpointError
from rfm.published import robometer
from rfm_client import InvalidSampleError
from rfm_client.contract import wire
from small_network import SMALL

# The same examples each time, so a failure repeats everywhere.
THOROUGH = settings(max_examples=100, deadline=None, derandomize=True, database=None)
SLOW = settings(
    max_examples=50, deadline=None, derandomize=True, database=None, suppress_health_check=[HealthCheck.too_slow]
)
Array = npt.NDArray[Any]


# The wire: whatever Triton lets through, of the declared types and ranks

FEW = st.integers(0, 4)
COUNTS = st.sampled_from([-(2**31), -1, 0, 1, 2, 3, 4, 5, 4096, 4097, 2**31 - 1])
FLOATS = st.floats(width=32, allow_nan=True, allow_infinity=True)


@st.composite
def requests(draw: st.DrawFn, *, frames: bool) -> dict[str, Array]:
    batch = draw(st.integers(1, 3))
    tensors: dict[str, Array] = {
        wire.SAMPLE_TYPE: draw(arrays.arrays(np.uint8, (batch, 1), elements=st.sampled_from([0, 1, 2, 3, 255]))),
        wire.NUM_FRAMES: draw(arrays.arrays(np.int32, (batch, 2), elements=COUNTS)),
        wire.FRAME_STEPS: draw(arrays.arrays(np.int32, (batch, 1), elements=COUNTS)),
    }
    positions = draw(FEW)
    if frames:
        shape = (batch, positions, draw(FEW), draw(FEW), 3)
        tensors[wire.FRAMES] = draw(arrays.arrays(np.uint8, shape))
        if draw(st.booleans()):
            shape = (batch, draw(FEW), draw(FEW), draw(FEW), 3)
            tensors[wire.SECOND_FRAMES] = draw(arrays.arrays(np.uint8, shape))
        tasks = draw(st.lists(st.binary(max_size=20), min_size=batch, max_size=batch))
        tensors[wire.TASK] = np.array([[task] for task in tasks], np.object_)
    else:
        tensors[wire.VIDEO_EMBEDDINGS] = draw(arrays.arrays(np.float32, (batch, positions, draw(FEW)), elements=FLOATS))
        tensors[wire.TEXT_EMBEDDING] = draw(arrays.arrays(np.float32, (batch, draw(FEW)), elements=FLOATS))
    return tensors


def told(error: InvalidSampleError) -> None:
    """Like all errors of input."""
    assert ": expected " in str(error)
    assert ", got " in str(error)
    assert len(str(error)) < 1000


@THOROUGH
@given(st.booleans().flatmap(lambda frames: requests(frames=frames)))
def test_any_request_is_samples_or_a_refusal(tensors: dict[str, Array]) -> None:
    try:
        samples = wire.decode_samples(tensors)
    except InvalidSampleError as error:
        told(error)
        return
    assert len(samples) == len(tensors[wire.NUM_FRAMES])
    shapes = {tuple(trajectory.positions.shape[1:] for trajectory in sample.trajectories) for sample in samples}
    if len(shapes) == 1:  # accepted values are kept whole
        again = wire.encode_samples(samples)
        np.testing.assert_array_equal(again[wire.NUM_FRAMES], tensors[wire.NUM_FRAMES])
        np.testing.assert_array_equal(again[wire.FRAME_STEPS], tensors[wire.FRAME_STEPS])


@THOROUGH
@given(requests(frames=True))
def test_any_request_to_the_encoder_is_trajectories_or_a_refusal(tensors: dict[str, Array]) -> None:
    try:
        samples = wire.decode_trajectories(tensors)
    except InvalidSampleError as error:
        told(error)
        return
    num_frames = [sum(trajectory.num_frames for trajectory in sample.trajectories) for sample in samples]
    assert num_frames == tensors[wire.NUM_FRAMES].astype(np.int64).sum(axis=1).tolist()


# The checkpoint loader: any change to a file is harmless or refused


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("original") / "checkpoint"
    torch.manual_seed(0)
    config = replace(SMALL, num_layers=1, progress_bins=3, max_len=7, trained_frames=4)
    RewindCheckpoint(config, RewindTransformer(config).state_dict()).save(folder)
    (folder / "config.yaml").write_text(
        "model:\n  rewind: {causal_mask: true, max_len: 7}\ndata: &d {max_frames: 4}\nmore: *d\n"
    )
    return folder


CHANGES = st.lists(
    st.tuples(
        st.floats(0, 1),
        st.sampled_from(["flip", "insert", "delete", "cut", "repeat"]),
        st.binary(min_size=1, max_size=8),
    ),
    min_size=1,
    max_size=4,
)
JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


def changed(content: bytes, changes: list[tuple[float, str, bytes]]) -> bytes:
    new = bytearray(content)
    for place, kind, given_bytes in changes:
        at = int(place * len(new))
        if kind == "flip" and at < len(new):
            new[at] ^= given_bytes[0] or 1
        elif kind == "insert":
            new[at:at] = given_bytes
        elif kind == "delete":
            del new[at : at + len(given_bytes)]
        elif kind == "cut":
            del new[at:]
        elif kind == "repeat":
            new[at:at] = new[at : at + 8 * len(given_bytes)]
    return bytes(new)


def loads_or_refuses(original: Path, file: str, content: bytes, load: Callable[[Path], object]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        copy = shutil.copytree(original, Path(folder, "checkpoint"), copy_function=shutil.copyfile)
        (copy / file).write_bytes(content)
        try:
            load(copy)
        except CheckpointError as error:
            assert 0 < len(str(error)) < 10_000


def built(folder: Path) -> object:
    return published.load(folder).build()


@SLOW
@given(file=st.sampled_from(["header", "model.safetensors", "config.json", "config.yaml"]), changes=CHANGES)
def test_any_bytes_are_a_checkpoint_or_refused(
    original: Path, file: str, changes: list[tuple[float, str, bytes]]
) -> None:
    if file != "header":
        loads_or_refuses(original, file, changed((original / file).read_bytes(), changes), built)
        return
    content = (original / "model.safetensors").read_bytes()
    length = int.from_bytes(content[:8], "little")
    header = changed(content[8 : 8 + length], changes)
    content = len(header).to_bytes(8, "little") + header + content[8 + length :]
    loads_or_refuses(original, "model.safetensors", content, built)


@SLOW
@given(data=st.data(), value=JSON_VALUES, is_vlm=st.booleans())
def test_any_setting_is_taken_or_refused(original: Path, data: st.DataObject, value: Any, is_vlm: bool) -> None:
    folder = goldens.config("q25_mean_l2").checkpoint if is_vlm else original
    content = json.loads((folder / "config.json").read_text())
    of_part = is_vlm and data.draw(st.sampled_from([None, "text_config", "vision_config"]))
    place = content[of_part] if of_part else content
    place[data.draw(st.sampled_from(sorted(place)))] = value
    load = (lambda copy: robometer.load(copy, CheckpointConfig())) if is_vlm else built
    loads_or_refuses(folder, "config.json", json.dumps(content).encode(), load)
