# SPDX-License-Identifier: MIT
"""The device on which an export is compared with the checkpoint. Missing GPUs are made up."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
from torch import Tensor

import goldens
import rfm_export
from captures import CalledAgain
from in_process import rfm
from rfm import published
from rfm.engine import Engine
from rfm.engine.family import NETWORK
from rfm.engine.graphs import Captured, Function, Graphs
from rfm_client import ProgressResult
from rfm_client.contract import Sample
from rfm_export import ExportDiffersError
from rfm_export.source import device_named
from rfm_export.verify import WORKING_ROOM, device_for, needing_room, verify_graphs

SMALL = goldens.config("c1_t1_disc10")
LARGE = next(iter(goldens.VLM))
PLAIN = goldens.config("q3_tok_disc10")


@pytest.fixture
def free_bytes(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Free bytes on each GPU."""
    free: list[float] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: bool(free))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: len(free))
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda index: (free[index], 2 * free[index]))
    return free


def test_a_large_network_goes_where_most_room_is(free_bytes: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    dtype = torch.bfloat16

    def full() -> tuple[float, float]:
        raise RuntimeError("CUDA error: out of memory")

    checkpoint = published.load(LARGE.checkpoint, base_model=str(LARGE.base_model))
    needed = WORKING_ROOM * sum(each.numel() * dtype.itemsize for each in checkpoint.parts[NETWORK].values())
    free_bytes[:] = [needed / 2, needed + 2, needed + 1]
    assert device_for(checkpoint, dtype, may_use_gpu=True) == torch.device("cuda", 1)
    assert device_for(checkpoint, dtype, may_use_gpu=False) == torch.device("cpu")
    free_bytes[:] = [needed / 2, needed - 1]
    assert device_for(checkpoint, dtype, may_use_gpu=True) == torch.device("cpu")
    free_bytes[:] = [needed + 1, needed + 2]
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda index: full() if index else (free_bytes[0], free_bytes[0]))
    assert device_for(checkpoint, dtype, may_use_gpu=True) == torch.device("cuda", 0)
    assert device_for(published.load(SMALL.checkpoint), dtype, may_use_gpu=True) == torch.device("cpu")
    free_bytes.clear()
    assert device_for(checkpoint, dtype, may_use_gpu=True) == torch.device("cpu")


def test_a_device_that_is_not_there_is_refused(free_bytes: list[float]) -> None:
    told = f"device: expected one of cpu, got cuda: PyTorch {torch.__version__} finds no GPU; --device cpu"
    with pytest.raises(rfm_export.ExportError, match=f"^{re.escape(told)}$"):
        device_named("cuda")
    free_bytes[:] = [1.0, 1.0]
    assert device_named("cuda:1") == torch.device("cuda", 1)
    with pytest.raises(rfm_export.ExportError, match="device: expected one of cpu, cuda, cuda:0, cuda:1, got cuda:2"):
        device_named("cuda:2")


def test_a_lack_of_gpu_memory_is_reported_in_one_line() -> None:
    reason = "CUDA out of memory. Tried to allocate 8 GiB.\nMore"
    with pytest.raises(rfm_export.ExportError) as error, needing_room(torch.device("cuda", 0)):
        raise torch.OutOfMemoryError(reason)
    assert str(error.value) == (
        "device: expected room on cuda:0 to compare the export with the checkpoint, got CUDA out of memory; "
        "rfm export --device names another one"
    )


def test_the_command_says_where_it_compares(tmp_path: Path) -> None:
    words = ["export", "--repository", str(tmp_path / "models"), "--checkpoint", str(LARGE.checkpoint)]
    words += ["--base-model", str(LARGE.base_model)]
    done = rfm(*words, "--num-gpus", "0", "--device", "cpu")
    assert done.exit_code == 0, done.output
    assert "rfm: comparing the export's scores with the checkpoint's on cpu ...\n" in done.output
    refused = rfm(*words, "--device", "tpu")
    assert (refused.exit_code, "device: expected one of cpu" in refused.output) == (1, True)


class Stale(CalledAgain):
    """Replays the inputs of the capture for ever."""

    def __call__(self, function: Function, tensors: Sequence[Tensor], beside: Captured | None) -> Captured:
        captured = super().__call__(function, tensors, beside)
        return replace(captured, inputs=[tensor.clone() for tensor in captured.inputs])


class Failing(CalledAgain):
    """Cannot capture."""

    def __call__(self, function: Function, tensors: Sequence[Tensor], beside: Captured | None) -> Captured:
        raise RuntimeError("made up")


def compare(capture: CalledAgain) -> tuple[Graphs, list[str]]:
    """Compare a reference checkpoint's graphs with plain passes. Also return the messages."""
    checkpoint, graphs, said = published.load(PLAIN.checkpoint, **PLAIN.sources), Graphs(capture), list[str]()
    engine = Engine(checkpoint.predictor(torch.device("cpu")), graphs=graphs)
    verify_graphs(lambda: engine, checkpoint.description, said.append)
    return graphs, said


def test_an_export_compares_graphs_with_plain_passes() -> None:
    graphs, said = compare(CalledAgain())
    assert graphs.num_replayed >= 2 * graphs.num_captured > 0
    assert said == []
    with pytest.raises(ExportDiffersError, match=r"cuda_graphs: expected the scores of a plain pass, got a difference"):
        compare(Stale())
    _, said = compare(Failing())
    assert said == ["cuda_graphs: this device cannot capture the network's passes, so the setting gains nothing here"]


class OfSeconds:
    """Stands in for an engine whose graphs differ from plain passes by a share of the seconds."""

    graphs = Graphs(CalledAgain())

    def __init__(self, share: float) -> None:
        self._share, self._known = share, set[int]()

    def evaluate(self, samples: Sequence[Sample]) -> list[ProgressResult]:
        (sample,) = samples
        graphed = id(sample) in self._known
        self._known.add(id(sample))
        seconds = np.array([400.0, 0.0]) * (1 + self._share * graphed)
        nothing = np.full(2, np.nan, np.float32)
        return [ProgressResult(progress=nothing, success=nothing, remaining_s=seconds)]


def test_seconds_of_graphs_may_differ_as_their_size_lets_them() -> None:
    description = published.load(PLAIN.checkpoint, **PLAIN.sources).description
    verify_graphs(lambda: cast(Engine, OfSeconds(5e-6)), description, print)
    with pytest.raises(ExportDiffersError, match="a difference of 2e-05 times the largest"):
        verify_graphs(lambda: cast(Engine, OfSeconds(2e-5)), description, print)
