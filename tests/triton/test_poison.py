# SPDX-License-Identifier: MIT
"""What a model process writes down of the batch it is working on, and whom it believes to be a health probe."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import goldens
import rfm.journal
import rfm_export
from engines import load_engine, serve_config
from rfm.execution import Execution
from rfm.journal import Journal
from rfm.probe import blank_question
from rfm.supervise.status import NO_REASON
from rfm.triton_model.batch_model import BatchModel
from rfm.triton_model.cancellation import Cancellation
from rfm.triton_model.metrics import Counted
from rfm.triton_model.quarantine import Quarantine, journals
from rfm.triton_model.request import Origins
from rfm.triton_model.request_digest import digest
from rfm.triton_model.self_check import SelfCheck
from rfm_client import InferenceFailedError, ProgressResult, ProgressSample, Result, Sample
from rfm_client.contract import wire
from rfm_client.contract.names import PROBE_PREFIX
from rfm_serve import PATIENCE_S, serving
from trajectories import random_trajectory

pytestmark = [pytest.mark.triton, pytest.mark.slow]

PLAIN = goldens.config("c1_t1_disc10")
WIDTHS = (4, 3)
CONFIG = {  # as Triton tells it to a model
    "input": [
        {"name": "sample_type", "dims": [1]},
        {"name": "num_frames", "dims": [2]},
        {"name": "frame_steps", "dims": [1]},
        {"name": "video_embeddings", "dims": [-1, WIDTHS[0]]},
        {"name": "text_embedding", "dims": [WIDTHS[1]]},
    ]
}
HANG_S = 2
DENSE_FRAMES = 8
# Each forward pass takes a quarter of HANG_S, and all of them twice as long as HANG_S.
SLOW_FORWARD = f"""

_load = TritonPythonModel.load


def load(self, version, device, settings):
    _load(self, version, device, settings)
    score = self.engine.predictor.score

    def slow(rows, batch):
        import time

        if any(row.picked is not None for row in rows):  # dense mode
            time.sleep({HANG_S / 4})
        return score(rows, batch)

    self.engine.predictor.score = slow


TritonPythonModel.load = load
"""


def test_a_batch_that_gets_on_is_no_hang_however_long_it_takes(tmp_path: Path) -> None:
    """In dense mode a sample is a row a frame, so that nothing bounds what a batch takes; a forward pass is bounded."""
    repository = tmp_path / "repository"
    rfm_export.export(PLAIN.checkpoint, repository, replace(serve_config(PLAIN), token_budget=10))
    model = repository / "rfm" / "1" / "model.py"
    model.write_text(model.read_text() + SLOW_FORWARD)
    config = tmp_path / "serve.yaml"
    config.write_text(json.dumps({"hang_s": HANG_S, "canary_s": 1}))  # a canary waits behind the batch
    sample = ProgressSample(random_trajectory(0, DENSE_FRAMES), frame_steps=4)
    (expected,) = load_engine(PLAIN.name).evaluate([sample])
    assert isinstance(expected, ProgressResult)
    with serving(repository, f"--config={config}") as served, served.client(retry=False) as client:
        served.wait_ready()
        (result,) = client.evaluate([sample], timing=True, timeout_s=PATIENCE_S)
        assert isinstance(result, ProgressResult)
        np.testing.assert_allclose(result.progress, expected.progress, rtol=0, atol=1e-5)
        assert result.timing is not None
        assert result.timing.forward_ms > 1.5e3 * HANG_S
        assert served.metric("rfm_serve_restarts_total") == 0


def test_a_model_whose_batch_gets_on_is_ready_however_long_its_probe_waits(tmp_path: Path) -> None:
    repository = tmp_path / "repository"
    rfm_export.export(PLAIN.checkpoint, repository, replace(serve_config(PLAIN), token_budget=10))
    model = repository / "rfm" / "1" / "model.py"
    model.write_text(model.read_text() + SLOW_FORWARD)
    config = tmp_path / "serve.yaml"
    config.write_text(json.dumps({"canary_s": 1}))
    sample = ProgressSample(random_trajectory(0, 3 * DENSE_FRAMES), frame_steps=4)
    with serving(repository, f"--config={config}") as served, served.client(retry=False) as client:
        served.wait_ready()
        with ThreadPoolExecutor(1) as pool:
            batch = pool.submit(client.evaluate, [sample], timeout_s=PATIENCE_S)
            was_late, reasons = False, set()
            while not batch.done():
                was_late = was_late or served.metric("rfm_serve_canary_ok", model="rfm") == 0
                reasons |= set(served.reasons().values())
            assert isinstance(batch.result()[0], ProgressResult)
        assert was_late  # else this shows nothing
        assert reasons == {NO_REASON}


def test_a_journal_tells_since_when_nothing_has_come_of_a_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 100.0
    monkeypatch.setattr(rfm.journal, "time", SimpleNamespace(monotonic=lambda: now_s))
    own = Quarantine(tmp_path / "1_batch", (), 4)
    journal = Journal.open(tmp_path / "1_batch")
    assert journal is not None
    with own.at_work_on([b"12345678"]):
        now_s += 20
        assert journal.busy_s == 20
        own.renew()
        assert journal.busy_s == 0
        now_s += 15
        assert (journal.busy_s, journal.digests) == (15, [b"12345678"])
    assert journal.busy_s == 0
    own.close()


def test_journals_are_those_of_the_model_and_the_server(tmp_path: Path) -> None:
    server, other = "triton_python_backend_shm_region_rfm_7_f_a", "triton_python_backend_shm_region_rfm_7_f_b"
    own = [f"{server}_0-1_rfm_batch", f"{server}_0-2_rfm_batch"]
    others = [f"{server}_0-3_b_rfm_batch", f"{server}_0-4_rfm_encoder_batch", f"{server}_0-5", f"{other}_0-6_rfm_batch"]
    for name in (*own, *others):
        (tmp_path / name).touch()
    assert sorted(file.name for file in journals(tmp_path, f"{server}_0-2", "rfm")) == own
    assert [file.name for file in journals(tmp_path, f"{server}_0-2", "b_rfm")] == [others[0]]


# Who is a health probe


@dataclass(frozen=True)
class Request:
    """As Triton hands it over, as far as a model asks."""

    id: str
    tensors: wire.Tensors

    def request_id(self) -> str:
        return self.id

    def requested_output_names(self) -> list[str]:
        return []

    def is_cancelled(self) -> bool:
        return False


class TritonError(Exception):
    INVALID_ARG, INTERNAL = 1, 2


class Model(BatchModel[Sample, Result]):
    """Never gets an answer, and says how many questions it was asked."""

    def __init__(self, deadly: Quarantine) -> None:
        self.input_names = [tensor["name"] for tensor in CONFIG["input"]]
        self.counted: list[Counted] = []
        self.asked = 0
        self._quarantine = deadly
        self._cancellation = Cancellation()
        self._origins = Origins(0, digest(blank_question(CONFIG)))
        self._self_check = SelfCheck(lambda: None, lambda error: None)
        self._metrics = SimpleNamespace(at_work_on=lambda batch: nullcontext(), add=self.counted.append)  # type: ignore[assignment]
        self._log = SimpleNamespace(report=lambda request: None)  # type: ignore[assignment]

    def decode(self, tensors: wire.Tensors) -> list[Sample]:
        return wire.decode_samples(tensors)

    def answer(self, questions: Sequence[Sample], execution: Execution) -> list[InferenceFailedError]:
        self.asked += len(questions)
        return [InferenceFailedError("no answer")] * len(questions)

    def encode(self, answers: Sequence[Result], tensors: wire.Tensors, outputs: Collection[str]) -> wire.Tensors:
        raise NotImplementedError


@pytest.fixture
def backend(monkeypatch: pytest.MonkeyPatch) -> None:
    """What of Triton's module a model needs to read a request and to refuse it."""

    def tensor_of(request: Request, name: str) -> Any:
        return SimpleNamespace(as_numpy=lambda: request.tensors[name])

    module = SimpleNamespace(
        get_input_tensor_by_name=tensor_of,
        InferenceResponse=lambda error: error,
        TritonError=TritonError,
    )
    monkeypatch.setitem(sys.modules, "triton_python_backend_utils", module)  # type: ignore[arg-type]


def sample_of(seed: int) -> wire.Tensors:
    return wire.encode_samples([ProgressSample(random_trajectory(seed, 3, *WIDTHS))])


def deadly(folder: Path, tensors: wire.Tensors) -> Quarantine:
    """What a process knows when two before it have died of these inputs."""
    code = "import os, sys; from pathlib import Path; from rfm.triton_model.quarantine import Journal\n"
    code += "with Journal.create(Path(sys.argv[1]), 1).at_work_on([bytes.fromhex(sys.argv[2])]): os._exit(1)"
    dead = [folder / "1_batch", folder / "2_batch"]
    for file in dead:
        subprocess.run([sys.executable, "-c", code, file, digest(tensors).hex()], check=False, timeout=PATIENCE_S)
    return Quarantine(folder / "3_batch", dead, 4)


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("request_id", ["", PROBE_PREFIX, f"{PROBE_PREFIX}-rfm"])
def test_poison_is_refused_and_counted_whoever_it_says_it_is_from(tmp_path: Path, request_id: str) -> None:
    model = Model(deadly(tmp_path, sample_of(0)))
    model.execute([Request(request_id, sample_of(0)), Request("", sample_of(1))])
    assert model.asked == 1
    (counted,) = model.counted
    assert counted.samples == {("progress", "refused"): 1, ("progress", "failed"): 1}
    assert counted.num_executed == 1  # what was refused took no part in it


@pytest.mark.usefixtures("backend")
def test_the_blank_question_of_a_probe_is_answered_and_not_counted(tmp_path: Path) -> None:
    blank = blank_question(CONFIG)
    model = Model(deadly(tmp_path, blank))
    model.execute([Request(f"{PROBE_PREFIX}-rfm", blank)])
    assert (model.asked, model.counted) == (1, [Counted()])
