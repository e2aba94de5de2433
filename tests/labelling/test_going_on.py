# SPDX-License-Identifier: MIT
"""What is finished stays finished: after a kill, beside another process, without a server, on a full disk."""

from __future__ import annotations

import errno
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

import labelling
from labelling import LEROBOT, BrightnessScorer, PickyScorer
from rfm_client import ProgressResult, ServerUnavailableError
from rfm_client.labelling import DatasetError, LabelOptions, Watch, label, open_dataset

ROOT = LEROBOT / "toy_v30_many"
FILES = ("rfm_progress.parquet", "reward_signals/rfm.parquet")
PATIENCE_S = 60


def contents(output: Path) -> list[bytes]:
    return [(output / name).read_bytes() for name in FILES]


def start(output: Path, *more: object) -> subprocess.Popen[bytes]:
    words = [sys.executable, labelling.__file__, str(ROOT), str(output), *map(str, more)]
    return subprocess.Popen(words, stderr=subprocess.PIPE)


def finish(process: subprocess.Popen[bytes]) -> None:
    _, told = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, told.decode()


def parts_of(output: Path) -> list[str]:
    return sorted(path.name for path in (output / ".rfm_parts").glob("*.parquet"))


def goes_on(output: Path, undisturbed: list[bytes], **options: Any) -> int:
    """How many frames the same call then scores, after which the labels are those of a run that nothing disturbed."""
    rest = BrightnessScorer()
    label(open_dataset(ROOT), rest, LabelOptions(output=output, **options))
    assert contents(output) == undisturbed
    return rest.num_samples


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    output = tmp_path_factory.mktemp("undisturbed")
    label(open_dataset(ROOT), BrightnessScorer(), LabelOptions(output=output))
    return contents(output)


@pytest.mark.slow
def test_a_run_that_is_killed_again_and_again_ends_as_one_that_was_not(output: Path, undisturbed: list[bytes]) -> None:
    random = np.random.default_rng(0)
    kills = 0
    while kills < 10:
        process = start(output, 0.02)
        try:
            process.wait(timeout=random.uniform(0.3, 2.5))
        except subprocess.TimeoutExpired:
            kills += 1
        process.kill()
        process.communicate()
        if all((output / name).exists() for name in FILES):
            assert contents(output) == undisturbed
            for file in [*(output / name for name in FILES), *list((output / ".rfm_parts").glob("*.parquet"))[:5]]:
                file.unlink()
    finish(start(output))
    assert contents(output) == undisturbed


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_of_two_processes_on_one_folder_one_may_end(
    output: Path, undisturbed: list[bytes], how: signal.Signals
) -> None:
    processes = [start(output, 0.05) for _ in range(2)]
    while len(parts_of(output)) < 2:
        assert all(process.poll() is None for process in processes)
        time.sleep(0.01)
    processes[0].send_signal(how)
    processes[0].communicate(timeout=PATIENCE_S)
    finish(processes[1])
    assert contents(output) == undisturbed


def test_two_runs_at_a_time_write_the_same_files(output: Path, undisturbed: list[bytes]) -> None:
    options = LabelOptions(output=output, workers=2)
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
    for shard in ((0, 3), (2, 3), (1, 3)):
        report = label(open_dataset(ROOT), BrightnessScorer(), LabelOptions(output=output, shard=shard))
        assert (report.files, report.failures, report.summary) == ([], [], None)
    assert len(parts_of(output)) == 10
    assert goes_on(output, undisturbed) == 0


class Failures(Watch):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def failed(self, episode: Any, error: Any) -> None:
        self.lines.append(f"{episode.name}: {error}")


def test_an_episode_that_fails_is_told_and_the_others_go_on(output: Path, undisturbed: list[bytes]) -> None:
    failures, dataset = Failures(), open_dataset(ROOT)
    failing = [episode for episode in dataset.episodes if episode.task == PickyScorer.REFUSED]
    assert failing
    report = label(dataset, PickyScorer(), LabelOptions(output=output), failures)
    assert [failure.episode for failure in report.failures] == failing
    assert sorted(failures.lines) == sorted(f"{e.name}: task: expected another one, got this" for e in failing)
    assert (report.files, (output / FILES[0]).exists()) == ([], False)
    assert goes_on(output, undisturbed) == 2 * sum(episode.num_frames for episode in failing)


def test_a_server_that_is_gone_stops_the_run_and_not_one_episode_after_the_other(
    output: Path, undisturbed: list[bytes]
) -> None:
    class Gone(BrightnessScorer):
        def evaluate(self, samples: Any) -> list[ProgressResult]:
            if self.num_samples >= 150:
                raise ServerUnavailableError("no server")
            return super().evaluate(samples)

    with pytest.raises(ServerUnavailableError, match=r"^no server$"):
        label(open_dataset(ROOT), Gone(), LabelOptions(output=output, workers=1))
    assert 0 < len(parts_of(output)) < 10
    goes_on(output, undisturbed)


def test_a_full_disk_stops_the_run_and_leaves_no_half_of_a_part(
    output: Path, undisturbed: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    synced = os.fsync
    count = 0

    def full(file: int) -> None:
        nonlocal count
        count += 1
        if count == 4:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        synced(file)

    monkeypatch.setattr(os, "fsync", full)
    advice = "make room or name another place with --parts, and run the same command"
    with pytest.raises(OSError, match=rf"\.rfm_parts: expected .* got No space left on device: {advice}$"):
        label(open_dataset(ROOT), BrightnessScorer(), LabelOptions(output=output, workers=1))
    assert len(parts_of(output)) == len(list((output / ".rfm_parts").iterdir())) == 3
    goes_on(output, undisturbed)


def test_a_folder_of_labels_is_made_and_one_that_cannot_be_written_is_refused(
    output: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = LabelOptions(output=output / "new" / "labels", limit=1)
    label(open_dataset(ROOT), BrightnessScorer(), options)
    assert (output / "new" / "labels" / FILES[0]).exists()
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    scorer = BrightnessScorer()
    with pytest.raises(DatasetError, match=r"labels: expected a folder .* that cannot be written: .* with --output$"):
        label(open_dataset(ROOT), scorer, options)
    assert scorer.num_samples == 0


BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "truncated": (lambda part: part.write_bytes(part.read_bytes()[:100]), "expected a whole part"),
    "another's": (
        lambda part: part.write_bytes(sorted(part.parent.glob("*.parquet"))[3].read_bytes()),
        "expected the part of episode 0",
    ),
}


@pytest.mark.parametrize(("break_it", "message"), BROKEN.values(), ids=BROKEN)
def test_a_part_that_is_not_whole_is_no_label(output: Path, break_it: Callable[[Path], object], message: str) -> None:
    label(open_dataset(ROOT), BrightnessScorer(), LabelOptions(output=output))
    before = contents(output)
    break_it(sorted((output / ".rfm_parts").glob("*.parquet"))[0])
    with pytest.raises(DatasetError, match=f"{message}.*delete it, and run the same command"):
        label(open_dataset(ROOT), BrightnessScorer(), LabelOptions(output=output))
    assert contents(output) == before


@pytest.mark.parametrize("url", ["memory://labels/parts", "file://{}/elsewhere"])
def test_parts_may_be_behind_a_url(output: Path, undisturbed: list[bytes], url: str) -> None:
    assert goes_on(output, undisturbed, parts=url.format(output)) == 2 * 428
    assert goes_on(output, undisturbed, parts=url.format(output)) == 0
    assert not (output / ".rfm_parts").exists()
