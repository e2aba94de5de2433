# SPDX-License-Identifier: MIT
"""When an instance of several takes more requests from Triton: real journals, and a real pipeline."""

from __future__ import annotations

import os
import struct
import subprocess
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from clock import Clock
from rfm.journal import NO_DIGEST, Journal
from rfm.triton_model import other_instances
from rfm.triton_model.other_instances import OtherInstances
from rfm.triton_model.pipeline import Bounds, Pipeline, Stages
from rfm_serve import PATIENCE_S, wait_for

MAX_WAITING = 2


@dataclass(eq=False)
class Job:
    num_samples: int = 1
    num_tokens: int = 1
    may_be_rejected: bool = True


@dataclass
class Instance:
    """This one, which scores its first job until ``may_score`` is set, and the journal of another."""

    pipeline: Pipeline[Job, None]
    other_instances: OtherInstances
    other: Journal
    may_score: threading.Event

    def wait(self) -> None:
        self.other_instances.wait_for_turn(self.pipeline, MAX_WAITING)


@pytest.fixture
def busy(tmp_path: Path) -> Iterator[Instance]:
    may_score = threading.Event()
    stages = Stages[Job, None](
        lambda batch: may_score.wait(PATIENCE_S) and None, lambda batch, scored: None, lambda error: None
    )
    pipeline = Pipeline(stages, Bounds(8, 100, 8))
    own, other = tmp_path / "own", Journal.create(tmp_path / "other", 1)
    pipeline.put([Job()])
    wait_for(lambda: pipeline.num_waiting == 0)
    yield Instance(pipeline, OtherInstances(lambda: [own, tmp_path / "other"], own), other, may_score)
    may_score.set()
    pipeline.close()


def test_while_another_is_idle_nothing_more_is_taken(busy: Instance) -> None:
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(busy.wait)
        assert not busy.pipeline.wait_for(waiting.done, 0.1)
        with busy.other.at_work_on([NO_DIGEST]):
            waiting.result(PATIENCE_S)


def test_where_all_are_busy_a_batch_is_taken_ahead_and_no_more(busy: Instance, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(other_instances, "LONG_S", PATIENCE_S)
    with busy.other.at_work_on([NO_DIGEST]), ThreadPoolExecutor(1) as pool:
        busy.wait()
        busy.pipeline.put([Job(), Job()])
        waiting = pool.submit(busy.wait)
        assert not busy.pipeline.wait_for(waiting.done, 0.1)
        busy.may_score.set()
        waiting.result(PATIENCE_S)


def test_where_all_have_enough_to_do_more_is_taken(busy: Instance, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that what is too much can be rejected."""
    monkeypatch.setattr(other_instances, "LONG_S", PATIENCE_S)
    busy.pipeline.put([Job() for _ in range(MAX_WAITING + 1)])
    with busy.other.at_work_on([NO_DIGEST]), ThreadPoolExecutor(1) as pool:
        busy.other.owe(MAX_WAITING)
        waiting = pool.submit(busy.wait)
        assert not busy.pipeline.wait_for(waiting.done, 0.1)
        busy.other.owe(1)
        waiting.result(PATIENCE_S)


def test_where_the_others_work_for_long_more_is_taken(busy: Instance, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that scores in ``execute`` owes nothing, and takes nothing from Triton either."""
    monkeypatch.setattr(other_instances, "LONG_S", 0.0)
    busy.pipeline.put([Job() for _ in range(MAX_WAITING)])
    with busy.other.at_work_on([NO_DIGEST]):
        busy.wait()


def test_an_instance_that_is_started_later_is_noticed_within_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    monkeypatch.setattr(other_instances, "time", clock)
    files = [tmp_path / "own"]
    others = OtherInstances(lambda: files, tmp_path / "own")
    assert others._are_busy(0, MAX_WAITING)
    Journal.create(tmp_path / "other", 1)
    files.append(tmp_path / "other")
    assert others._are_busy(0, MAX_WAITING)
    clock.sleep(1.0)
    assert not others._are_busy(0, MAX_WAITING)


def test_one_that_is_long_at_work_on_what_it_owes_takes_more_before_this_one(
    busy: Instance, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its ``execute`` has returned."""
    monkeypatch.setattr(other_instances, "LONG_S", 0.0)
    busy.pipeline.put([Job() for _ in range(MAX_WAITING)])
    busy.other.owe(1)
    with busy.other.at_work_on([NO_DIGEST]), ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(busy.wait)
        assert not busy.pipeline.wait_for(waiting.done, 0.1)
        busy.may_score.set()
        waiting.result(PATIENCE_S)


@pytest.mark.parametrize("other_version", ["1", "2"])
def test_an_idle_instance_is_waited_for_by_those_of_its_version_alone(
    busy: Instance, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other_version: str
) -> None:
    """While versions take turns, Triton gives it no request of another's."""
    journals = [tmp_path / "own", tmp_path / "other"]
    Journal.create(journals[0], 1)
    with subprocess.Popen(["sleep", str(3 * PATIENCE_S)]) as other, ThreadPoolExecutor(1) as pool:
        journals[1].write_bytes(struct.pack("<Q", other.pid) + journals[1].read_bytes()[8:])
        arguments = {os.getpid(): ["stub", "rfm/1/model.py"], other.pid: ["stub", f"rfm/{other_version}/model.py"]}
        monkeypatch.setattr(other_instances, "arguments_of", arguments.__getitem__)
        monkeypatch.setattr(other_instances, "all_journals", lambda model: journals)
        monkeypatch.setattr(other_instances, "own_journal", lambda model: journals[0])
        waiting = pool.submit(OtherInstances.of_this_process("rfm").wait_for_turn, busy.pipeline, MAX_WAITING)
        try:
            if other_version == "1":
                assert not busy.pipeline.wait_for(waiting.done, 0.1)
            else:
                waiting.result(PATIENCE_S / 4)  # less than this instance waits for its first job
        finally:
            other.kill()
            busy.may_score.set()


def test_one_that_may_hang_takes_nothing_whatever_it_owes(busy: Instance, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(other_instances, "STUCK_S", 0.0)
    busy.pipeline.put([Job() for _ in range(MAX_WAITING)])
    busy.other.owe(1)
    with busy.other.at_work_on([NO_DIGEST]):
        busy.wait()


def test_an_idle_instance_waits_for_nobody(busy: Instance) -> None:
    busy.may_score.set()
    assert busy.pipeline.wait_for(lambda: busy.pipeline.is_idle, PATIENCE_S)
    busy.wait()


@pytest.mark.parametrize(
    ("num_owed", "busy_s", "has_enough"), [(0, 0.09, False), (0, 0.1, True), (1, 4.9, False), (1, 5.0, True)]
)
def test_how_long_others_are_waited_for(num_owed: int, busy_s: float, has_enough: bool) -> None:
    """One that owes nothing and computes waits in ``execute``; one that owes answers for so long may hang."""
    journal = cast(Journal, SimpleNamespace(busy_s=busy_s, num_owed=num_owed))
    assert other_instances._has(journal, MAX_WAITING) == has_enough
