# SPDX-License-Identifier: MIT
"""Which model processes are dead or hang, told from a /proc of the test's own."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from rfm import journal, proc
from rfm.journal import Journal, journal_file
from rfm.supervise import model_processes
from rfm.supervise.model_processes import ModelProcess, ProcessWatch

TRITON = 10
MODEL = "rfm"
ONE, TWO = (MODEL, 1), (MODEL, 2)


class Machine:
    """Its processes and shared memory are files in ``folder``."""

    def __init__(self, folder: Path) -> None:
        self.proc, self.memory = folder / "proc", folder / "shm"
        self.proc.mkdir()
        self.memory.mkdir()

    def start(self, pid: int, version: int, *, started_s: float | None = None) -> None:
        (self.proc / str(pid)).mkdir(exist_ok=True)
        words = ["/b/triton_python_backend_stub", f"/r/{MODEL}/{version}/model.py", f"region_{pid}"]
        (self.proc / str(pid) / "cmdline").write_bytes("\0".join(words).encode())
        boot_s = time.clock_gettime(time.CLOCK_BOOTTIME) if started_s is None else started_s
        self._write(pid, "S", int(boot_s * os.sysconf("SC_CLK_TCK")))

    def die(self, pid: int) -> None:
        """As a zombie, which has no command line."""
        started = (self.proc / str(pid) / "stat").read_text().split()[-1]
        self._write(pid, "Z", int(started))
        (self.proc / str(pid) / "cmdline").write_bytes(b"")

    def reap(self, pid: int) -> None:
        for name in ("stat", "cmdline"):
            (self.proc / str(pid) / name).unlink()
        (self.proc / str(pid)).rmdir()

    def journal(self, pid: int) -> Journal:
        return Journal.create(journal_file(f"region_{pid}", MODEL), 1)

    def _write(self, pid: int, state: str, started_ticks: int) -> None:
        zeros = " ".join(["0"] * 17)
        (self.proc / str(pid) / "stat").write_text(f"{pid} (a) b) {state} {TRITON} {zeros} {started_ticks}")


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    machine = Machine(tmp_path)
    monkeypatch.setattr(proc, "_PROC", machine.proc)
    monkeypatch.setattr(journal, "SHARED_MEMORY", machine.memory)
    monkeypatch.setattr(model_processes, "CONFIRM_S", 0.0)
    return machine


def pids(found: list[ModelProcess]) -> list[int]:
    return sorted(process.pid for process in found)


def later_s() -> float:
    """Behind the start of all that runs, whose time has a grain of a hundredth of a second."""
    return time.monotonic() + 1.0


def test_the_dead_of_a_version_that_is_ready_are_reported_until_they_are_forgotten(machine: Machine) -> None:
    watch = ProcessWatch(TRITON, 30.0)
    machine.start(21, 1)
    machine.start(22, 1)
    watch.update({ONE}, set(), later_s())
    assert watch.dead() == []
    machine.die(22)
    assert pids(watch.dead()) == [22]
    assert pids(watch.of_model(MODEL)) == [21, 22]
    watch.forget(watch.dead())
    assert watch.dead() == []
    assert pids(watch.of_model(MODEL)) == [21]


def test_a_version_that_loads_is_left_to_triton(machine: Machine) -> None:
    """It may die, and its warm-up may take as long as it takes."""
    watch = ProcessWatch(TRITON, 0.0)
    for pid, version in ((21, 1), (31, 2), (32, 2)):
        machine.start(pid, version)
    with machine.journal(21).at_work_on([b"12345678"]), machine.journal(32).at_work_on([b"12345678"]):
        watch.update({ONE}, {TWO}, later_s())
        machine.die(31)
        assert watch.dead() == []
        assert pids([process for process, _ in watch.hung()]) == [21]
        watch.update({ONE, TWO}, set(), later_s())
        assert pids([process for process, _ in watch.hung()]) == [21, 32]


def test_of_a_version_that_is_loaded_once_more_the_old_ones_count_until_they_are_gone(machine: Machine) -> None:
    watch = ProcessWatch(TRITON, 30.0)
    machine.start(21, 1)
    watch.update({ONE}, set(), later_s())
    machine.start(22, 1)
    watch.update({ONE}, set(), later_s())
    machine.die(22)
    assert watch.dead() == []
    machine.die(21)
    assert pids(watch.dead()) == [21]
    machine.reap(21)
    watch.update({ONE}, set(), later_s())
    assert pids(watch.dead()) == [22]


def test_what_was_started_after_triton_was_asked_is_not_loaded(machine: Machine) -> None:
    watch = ProcessWatch(TRITON, 30.0)
    requested_s = time.monotonic() - 5.0
    machine.start(21, 1)
    watch.update({ONE}, set(), requested_s)
    machine.die(21)
    assert watch.dead() == []


def test_another_process_of_the_same_id_is_another(machine: Machine) -> None:
    watch = ProcessWatch(TRITON, 30.0)
    machine.start(21, 1, started_s=1.0)
    watch.update({ONE}, set(), later_s())
    (old,) = watch.all
    machine.start(21, 1, started_s=2.0)
    assert not old.is_alive
    watch.forget([old])
    assert pids(watch.of_model(MODEL)) == [21]
