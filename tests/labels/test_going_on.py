# SPDX-License-Identifier: MIT
"""Finished episodes stay finished: after a kill, beside another process, without a server, on a full disk."""

from __future__ import annotations

import errno
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

import labelling
from labelling import FEW, LEROBOT, BrightnessScorer, Notes, PickyScorer
from rfm_client import ProgressResult, ServerUnavailableError
from rfm_labels import DatasetError, LabelOptions, label, open_dataset

ROOT = LEROBOT / "toy_v30_many"
FILES = ("rfm_progress.parquet", "reward_signals/rfm.parquet")
NUM_FRAMES = 428


def contents(output: Path) -> list[bytes]:
    return [(output / name).read_bytes() for name in FILES]


def parts_of(output: Path) -> list[str]:
    return sorted(path.name for path in (output / ".rfm_parts").glob("*.parquet"))


def goes_on(output: Path, undisturbed: list[bytes], **options: Any) -> int:
    """Repeat the call and compare with the labels of an undisturbed run. Return the number of scored frames."""
    rest = BrightnessScorer()
    label(open_dataset(ROOT), rest, LabelOptions(output=output, **FEW, **options))
    assert contents(output) == undisturbed
    return rest.num_samples


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    output = tmp_path_factory.mktemp("undisturbed")
    label(open_dataset(ROOT), BrightnessScorer(), LabelOptions(output=output, **FEW))
    return contents(output)


@pytest.mark.slow
def test_a_process_that_is_killed_again_and_again_keeps_its_finished_parts(
    output: Path, undisturbed: list[bytes]
) -> None:
    for how in (signal.SIGKILL, signal.SIGINT, signal.SIGKILL):
        num_before = len(parts_of(output))
        words = [sys.executable, labelling.__file__, str(ROOT), str(output), "0.5"]
        process = subprocess.Popen(words, stderr=subprocess.DEVNULL)
        while len(parts_of(output)) == num_before:
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(how)
        assert process.wait(timeout=60) != 0
    assert not (output / FILES[0]).exists()
    assert 0 < goes_on(output, undisturbed) < NUM_FRAMES


KILLED = """
import itertools, os, runpy, signal, sys
program, left = sys.argv[1], itertools.count(int(sys.argv.pop(2)), -1)
sys.argv[:] = sys.argv[1:]
os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL) if next(left) == 0 else None
sys.path.insert(0, os.path.dirname(program))
runpy.run_path(program, run_name="__main__")
"""


@pytest.mark.slow
def test_a_run_that_is_killed_while_it_writes_leaves_nothing_after_the_next(
    output: Path, undisturbed: list[bytes]
) -> None:
    """Killed before the first of 10 parts is synced, then before each of both label files is."""
    for count in (0, 10, 1):
        words = [sys.executable, "-c", KILLED, labelling.__file__, str(count), str(ROOT), str(output), "0"]
        killed = subprocess.run(words, capture_output=True, text=True, check=False)
        assert killed.returncode == -signal.SIGKILL, killed.stderr
        assert list(output.rglob(".*.tmp"))
    goes_on(output, undisturbed)
    assert not list(output.rglob(".*.tmp"))


def test_two_runs_at_a_time_write_the_same_files(output: Path, undisturbed: list[bytes]) -> None:
    options = LabelOptions(output=output, workers=2, **FEW)
    threads = [
        threading.Thread(target=label, args=(open_dataset(ROOT), BrightnessScorer(0.01), options)) for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert contents(output) == undisturbed
    assert len(parts_of(output)) == 10


def test_shards_are_put_together_by_a_run_without_one(output: Path, undisturbed: list[bytes]) -> None:
    output = output / "a new" / "folder"
    for shard in ((0, 3), (2, 3), (1, 3)):
        report = label(open_dataset(ROOT), BrightnessScorer(), LabelOptions(output=output, shard=shard, **FEW))
        assert (report.files, report.failures, report.summary) == ([], [], None)
    assert len(parts_of(output)) == 10
    assert goes_on(output, undisturbed) == 0


def test_a_failing_episode_is_reported_and_the_others_are_labelled(output: Path, undisturbed: list[bytes]) -> None:
    notes, dataset = Notes(), open_dataset(ROOT)
    failing = [episode for episode in dataset.episodes if episode.task == PickyScorer.REFUSED]
    assert failing
    report = label(dataset, PickyScorer(), LabelOptions(output=output, **FEW), notes)
    assert [failure.episode for failure in report.failures] == failing
    assert sorted(notes.failures) == sorted(f"{e.name}: task: expected another one, got this" for e in failing)
    assert (report.files, (output / FILES[0]).exists()) == ([], False)
    assert goes_on(output, undisturbed) == sum(episode.num_frames for episode in failing)


def test_a_server_that_is_gone_stops_the_run(output: Path, undisturbed: list[bytes]) -> None:
    class Gone(BrightnessScorer):
        def evaluate(self, samples: Any) -> list[ProgressResult]:
            if self.num_samples >= 150:
                raise ServerUnavailableError("no server")
            return super().evaluate(samples)

    with pytest.raises(ServerUnavailableError, match=r"^no server$"):
        label(open_dataset(ROOT), Gone(), LabelOptions(output=output, workers=1, **FEW))
    assert 0 < len(parts_of(output)) < 10
    goes_on(output, undisturbed)


def test_an_episode_that_is_scored_at_once_ends_when_the_run_stops(output: Path) -> None:
    both_began = threading.Barrier(2, timeout=60)

    class Gone(BrightnessScorer):
        def curve(self, trajectory: Any, sampling: Any, go_on: Callable[[], None]) -> ProgressResult:
            if both_began.wait() == 0:
                raise ServerUnavailableError("no server")
            while True:
                go_on()

    with pytest.raises(ServerUnavailableError, match=r"^no server$"):
        label(open_dataset(ROOT), Gone(), LabelOptions(output=output, workers=2, **FEW))
    assert parts_of(output) == []


def full_disk(monkeypatch: pytest.MonkeyPatch, after: int) -> None:
    """Files reach the disk ``after`` times."""
    synced, counts = os.fsync, itertools.count(1)

    def sync(file: int) -> None:
        if next(counts) > after:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        synced(file)

    monkeypatch.setattr(os, "fsync", sync)


def test_a_full_disk_stops_the_run_and_leaves_no_half_of_a_part(
    output: Path, undisturbed: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    full_disk(monkeypatch, after=3)
    advice = "make room or name another place with --parts, and run the same command"
    with pytest.raises(OSError, match=rf"\.rfm_parts: expected .* got No space left on device: {advice}$"):
        label(open_dataset(ROOT), BrightnessScorer(), LabelOptions(output=output, workers=1, **FEW))
    assert len(parts_of(output)) == len(list((output / ".rfm_parts").iterdir())) == 3
    monkeypatch.undo()
    goes_on(output, undisturbed)


BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "truncated": (lambda part: part.write_bytes(part.read_bytes()[:100]), "expected a whole part"),
    "another's": (
        lambda part: part.write_bytes(sorted(part.parent.glob("*.parquet"))[3].read_bytes()),
        "expected the part of episode 0",
    ),
}


@pytest.mark.parametrize(("break_it", "message"), BROKEN.values(), ids=BROKEN)
def test_a_part_that_is_not_whole_is_no_label(
    output: Path, undisturbed: list[bytes], break_it: Callable[[Path], object], message: str
) -> None:
    goes_on(output, undisturbed)
    break_it(sorted((output / ".rfm_parts").glob("*.parquet"))[0])
    with pytest.raises(DatasetError, match=f"{message}.*delete it, and run the same command"):
        goes_on(output, undisturbed)
    assert contents(output) == undisturbed


def test_parts_may_be_behind_a_url(output: Path, undisturbed: list[bytes]) -> None:
    assert goes_on(output, undisturbed, parts="memory://labels/parts") == NUM_FRAMES
    assert goes_on(output, undisturbed, parts="memory://labels/parts") == 0
    assert not (output / ".rfm_parts").exists()


def test_a_label_file_that_cannot_be_replaced_is_named_with_those_that_are_new(output: Path) -> None:
    (output / FILES[1]).mkdir(parents=True)
    with pytest.raises(
        OSError, match=rf"{FILES[1]}: cannot be replaced: Is a directory; .*{FILES[0]} is new already: make"
    ):
        label(open_dataset(ROOT), BrightnessScorer(), LabelOptions(output=output, limit=1, overwrite=True, **FEW))
    assert (output / FILES[0]).is_file()


SPOILT: dict[str, Callable[[Any], Any]] = {
    "a value": lambda table: table.set_column(3, table.schema.field(3), [np.zeros(len(table), np.float32)]),
    "fewer rows": lambda table: table.slice(1),
    "no metadata": lambda table: table.replace_schema_metadata({}),
}


@pytest.mark.parametrize("spoil", [*SPOILT.values(), None], ids=[*SPOILT, "the second of both is not written"])
def test_label_files_that_are_not_written_or_read_back_otherwise_change_no_file(
    output: Path, monkeypatch: pytest.MonkeyPatch, spoil: Callable[[Any], Any] | None
) -> None:
    options = LabelOptions(output=output, limit=1, **FEW)
    label(open_dataset(ROOT), BrightnessScorer(), options)
    before = [(output / name).stat().st_ino for name in FILES]
    write = parquet.write_table

    def spoilt(table: Any, file: Any, **more: Any) -> None:
        assert spoil is not None
        write(spoil(table) if "reward" not in str(table.column_names) else table, file, **more)

    if spoil is None:
        full_disk(monkeypatch, after=1)
        message = "No space left on device: make"
    else:
        monkeypatch.setattr(parquet, "write_table", spoilt)
        message = r"rfm_progress\.parquet: expected the labels that were written, read others: make"
    with pytest.raises(OSError, match=message):
        label(open_dataset(ROOT), BrightnessScorer(), options)
    assert [(output / name).stat().st_ino for name in FILES] == before
    assert sorted(file.name for file in output.iterdir()) == [".rfm_parts", "reward_signals", "rfm_progress.parquet"]
