# SPDX-License-Identifier: MIT
"""What a model process writes down of the batch it is working on, and whom it believes to be a health probe."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import goldens
import rfm.journal
import rfm_export
from batch_models import CONFIG, WIDTHS, Tensor
from engines import load_engine, serve_config
from rfm.execution import Execution
from rfm.journal import Journal, journal_file, journal_files
from rfm.probe import blank_question
from rfm.supervise.status import NO_REASON
from rfm.triton_model import quarantine
from rfm.triton_model.batch_model import BatchModel
from rfm.triton_model.metrics import Counted
from rfm.triton_model.quarantine import Quarantine
from rfm.triton_model.request_digest import digest
from rfm_client import InferenceFailedError, ProgressResult, ProgressSample, Result, Sample
from rfm_client.contract import wire
from rfm_client.contract.names import PROBE_PREFIX
from rfm_serve import PATIENCE_S, serving, wait_for
from trajectories import random_trajectory

pytestmark = [pytest.mark.triton, pytest.mark.slow]

PLAIN = goldens.config("c1_t1_disc10")
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


def test_a_journal_names_what_is_prepared_and_its_progress_hides_no_hang(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 100.0
    monkeypatch.setattr(rfm.journal, "time", SimpleNamespace(monotonic=lambda: now_s))
    own = Quarantine(tmp_path / "1_batch", (), 4, 2)
    journal = Journal.open(tmp_path / "1_batch")
    assert journal is not None
    with own.at_work_on([b"in_batch"]):
        now_s += 20
        with own.preparing(b"prepared"):
            now_s += 5
            with own.preparing(b"in_there"):
                assert journal.busy_s == 25
                assert sorted(journal.digests) == [b"in_batch", b"in_there", b"prepared"]
            own.renew()
            assert journal.busy_s == 5
        assert (journal.busy_s, journal.digests) == (0, [b"in_batch"])
    with own.preparing(b"prepared"):
        now_s += 7
        assert (journal.busy_s, journal.digests) == (7, [b"prepared"])
        journal.forget(b"prepared")
        assert journal.digests == [rfm.journal.NO_DIGEST]
    assert (journal.busy_s, journal.digests) == (0, [])
    own.close()


def test_nobody_is_a_suspect_for_ever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sample = sample_of(0)
    known = deadly(tmp_path, sample)
    assert known.has_suspects
    assert known.is_suspect(digest(sample))
    now_s = time.monotonic()
    monkeypatch.setattr(quarantine, "time", SimpleNamespace(monotonic=lambda: now_s + quarantine.QUARANTINE_S + 1))
    assert not known.has_suspects
    assert not known.is_suspect(digest(sample))
    known.check(digest(sample))


def test_journals_are_those_of_the_model_and_the_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rfm.journal, "SHARED_MEMORY", tmp_path)
    server, other = "triton_python_backend_shm_region_rfm_7_f_a", "triton_python_backend_shm_region_rfm_7_f_b"
    own = [f"{server}_0-1_rfm_batch", f"{server}_0-2_rfm_batch"]
    others = [f"{server}_0-3_b_rfm_batch", f"{server}_0-4_rfm_encoder_batch", f"{server}_0-5", f"{other}_0-6_rfm_batch"]
    for name in (*own, *others):
        (tmp_path / name).touch()
    assert sorted(file.name for file in journal_files(f"{server}_0-2", "rfm")) == own
    assert [file.name for file in journal_files(f"{server}_0-2", "b_rfm")] == [others[0]]
    assert journal_file(f"{server}_0-1", "rfm") == tmp_path / own[0]


# Who is a health probe


@dataclass
class Request:
    """As Triton hands it over, as far as a model asks, and what is sent in answer."""

    id: str
    tensors: wire.Tensors
    responses: list[Any] = field(default_factory=list)

    def request_id(self) -> str:
        return self.id

    def inputs(self) -> list[Tensor]:
        return [Tensor(name, array) for name, array in self.tensors.items()]

    def requested_output_names(self) -> list[str]:
        return []

    def timeout(self) -> int:
        return 0

    def get_response_sender(self) -> Request:
        return self

    def is_cancelled(self) -> bool:
        return False

    def send(self, response: Any, flags: int) -> None:
        self.responses.append(response)


class TritonError(Exception):
    INVALID_ARG, INTERNAL, CANCELLED, UNAVAILABLE = range(4)


class Model(BatchModel[Sample, Result]):
    """Never gets an answer, and says how many questions it was asked, and how many it was told to work ahead on."""

    def __init__(self, deadly: Quarantine, num_preparing: int = 0) -> None:
        self.ahead = 0
        self.counted: list[Counted] = []
        self.asked = 0
        self._quarantine = deadly
        self._metrics = SimpleNamespace(at_work_on=lambda batch: nullcontext(), add=self.counted.append)  # type: ignore[assignment]
        self._log = SimpleNamespace(report=lambda request: None, report_end=lambda error: None)  # type: ignore[assignment]
        self.start({**CONFIG, "max_batch_size": 4}, {}, num_preparing=num_preparing)

    def decode(self, tensors: wire.Tensors) -> list[Sample]:
        return wire.decode_samples(tensors)

    def work_ahead(self, prepared: Sample) -> None:
        self.ahead += 1

    def answer(self, questions: Sequence[Sample], execution: Execution) -> list[InferenceFailedError]:
        self.asked += len(questions)
        return [InferenceFailedError("no answer")] * len(questions)

    def encode(self, answers: Sequence[Result], tensors: wire.Tensors, outputs: Collection[str]) -> wire.Tensors:
        raise NotImplementedError


@pytest.fixture
def backend(monkeypatch: pytest.MonkeyPatch) -> None:
    """What of Triton's module a model needs to refuse a request."""
    module = SimpleNamespace(
        InferenceResponse=lambda error: error,
        TritonError=TritonError,
        TRITONSERVER_RESPONSE_COMPLETE_FINAL=1,
    )
    monkeypatch.setitem(sys.modules, "triton_python_backend_utils", module)  # type: ignore[arg-type]


def sample_of(seed: int) -> wire.Tensors:
    return wire.encode_samples([ProgressSample(random_trajectory(seed, 3, *WIDTHS))])


def deadly(folder: Path, tensors: wire.Tensors) -> Quarantine:
    """What a process knows when two before it have died of these inputs."""
    dead = [died_of(folder / f"{number}_batch", tensors, work) for number, work in enumerate((SCORING, PREPARING))]
    return Quarantine(folder / "3_batch", dead, 4)


SCORING, PREPARING = "at_work_on([digest])", "preparing(0, digest)"


def died_of(file: Path, tensors: wire.Tensors, work: str) -> Path:
    """The journal of a process that has died in its ``work`` on these inputs."""
    code = "import os, sys; from pathlib import Path; from rfm.triton_model.quarantine import Journal\n"
    code += f"digest = bytes.fromhex(sys.argv[2])\nwith Journal.create(Path(sys.argv[1]), 1, 1).{work}: os._exit(1)"
    subprocess.run([sys.executable, "-c", code, file, digest(tensors).hex()], check=False, timeout=PATIENCE_S)
    return file


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("request_id", ["", PROBE_PREFIX, f"{PROBE_PREFIX}-rfm"])
def test_poison_is_refused_and_counted_whoever_it_says_it_is_from(tmp_path: Path, request_id: str) -> None:
    model = Model(deadly(tmp_path, sample_of(0)))
    respond(model, Request(request_id, sample_of(0)), Request("", sample_of(1)))
    assert model.asked == 1
    samples = sum((counted.samples for counted in model.counted), Counter[tuple[str, str]]())
    assert samples == {("progress", "refused"): 1, ("progress", "failed"): 1}
    assert sum(counted.num_executed for counted in model.counted) == 1  # what was refused took no part in it


@pytest.mark.usefixtures("backend")
def test_the_blank_question_of_a_probe_is_answered_and_not_counted(tmp_path: Path) -> None:
    blank = blank_question(CONFIG)
    model = Model(deadly(tmp_path, blank))
    respond(model, Request(f"{PROBE_PREFIX}-rfm", blank))
    assert (model.asked, model.counted) == (1, [Counted()])


@pytest.mark.usefixtures("backend")
def test_nothing_is_prepared_beside_a_batch_while_there_are_suspects(tmp_path: Path) -> None:
    suspect, other = sample_of(0), sample_of(1)
    known = Quarantine(tmp_path / "3_batch", [died_of(tmp_path / "1_batch", suspect, PREPARING)], 4, 2)
    model = Model(known, num_preparing=2)
    model._cheap_answer_s = 0.0  # two requests go through the pipeline, whatever they take
    respond(model, Request("", other), Request("", other))
    assert (model.asked, model.ahead) == (2, 0)
    respond(model, Request("", suspect))
    assert not known.has_suspects  # this process has survived it
    respond(model, Request("", other), Request("", suspect))
    assert (model.asked, model.ahead) == (5, 2)


def respond(model: Model, *requests: Request) -> None:
    """Returns when each has its answer, and is counted."""
    for request, response in zip(requests, model.execute(requests) or (), strict=False):
        request.responses.append(response)
    wait_for(lambda: all(request.responses for request in requests) and model.counted)
