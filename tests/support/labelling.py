# SPDX-License-Identifier: MIT
"""Labelling without a server: a short scorer, and a process for tests to kill.

python tests/support/labelling.py DATASET OUTPUT SECONDS_A_REQUEST
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from rfm_client import InvalidSampleError, ProgressResult, ProgressSample, RewardError, Trajectory, UInt8Array
from rfm_client.frames import Sampling
from rfm_labels import CheckpointFacts, DatasetEpisode, LabelOptions, RayOptions, Scorer, Watch, label, open_dataset
from rfm_labels.datasets.stored_files import digest_of as digest_of

LEROBOT = Path(__file__).parents[1] / "lerobot"
FRONT, WRIST = "observation.images.front", "observation.images.wrist"
FEW: dict[str, Any] = {"cameras": (WRIST,), "frames": 2}  # options with which a run takes a moment


class BrightnessScorer:
    """Progress is the brightness of a slot's frame, success the redness, so tests can recompute both."""

    def __init__(
        self,
        seconds: float = 0.0,
        digest: str = "brightness",
        max_frames: int | None = 16,
        settings: str = "settings",
        computation: str | None = "float32, torch 2.13.0, sdpa",
    ) -> None:
        self.seconds = seconds
        self.digest = digest
        self.settings = settings
        self.computation = computation
        self.max_frames = max_frames
        self.num_samples = 0
        self.tasks: set[str] = set()
        self._lock = threading.Lock()

    def checkpoint(self) -> CheckpointFacts:
        facts = CheckpointFacts("toy/brightness", None, self.digest, self.settings, self.max_frames, None, False, False)
        return replace(facts, computation=self.computation)

    def encode(self, frames: UInt8Array, task: str) -> Trajectory:
        raise AssertionError("it does not encode")

    def evaluate(self, samples: Sequence[ProgressSample]) -> list[ProgressResult]:
        time.sleep(self.seconds)
        with self._lock:
            self.num_samples += len(samples)
            self.tasks |= {sample.trajectory.task for sample in samples}
        return [self._result(sample) for sample in samples]

    def _result(self, sample: ProgressSample) -> ProgressResult:
        frames = sample.trajectory.frames
        assert frames is not None
        return ProgressResult(progress=brightness(frames), success=redness(frames))


class ByCurve(BrightnessScorer):
    """Is asked for the prefixes of an episode at once, as ``ClientScorer`` is."""

    def curve(self, trajectory: Trajectory, sampling: Sampling, go_on: Callable[[], None]) -> ProgressResult:
        results: list[ProgressResult] = []
        for samples in sampling.parts(trajectory):
            go_on()
            results += self.evaluate(samples)
        return sampling.joined(results)


class PickyScorer(BrightnessScorer):
    """Refuses the samples of one task."""

    REFUSED = "put the red block on the plate"

    def __init__(self, refused: str = REFUSED) -> None:
        super().__init__()
        self.refused = refused

    def evaluate(self, samples: Sequence[ProgressSample]) -> list[ProgressResult]:
        if samples[0].trajectory.task == self.refused:
            raise InvalidSampleError.at("task", "another one", "this")
        return super().evaluate(samples)


class Notes(Watch):
    """Keeps the messages of a run."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.failures: list[str] = []

    def note(self, text: str) -> None:
        self.lines.append(text)

    def failed(self, episode: DatasetEpisode, error: RewardError) -> None:
        self.failures.append(f"{episode.name}: {error}")


def command(
    source: Path,
    labels: LabelOptions,
    scorer: Scorer,
    say: Callable[[str], None] = print,
    *,
    task: str | None = None,
    reader: str | None = None,
    **run: bool,
) -> int:
    """Run ``rfm-client label`` with a scorer instead of a server. Return the exit code.

    say: gets each line of its output; run: ``dry_run``
    """
    from rfm_labels.commands.label import EpisodeTexts, LabelCommand, RunOptions

    texts, options = EpisodeTexts(task=task, reader=reader), RunOptions(**run)
    return LabelCommand(str(source), texts, labels, options, RayOptions(), lambda: nullcontext(scorer), say).run()


def change_column(file: Path, column: str, change: Callable[[list[Any]], list[Any]]) -> None:
    """Change the values of a column of a Parquet file."""
    table = parquet.read_table(file, partitioning=None)
    place, kind = table.column_names.index(column), table.schema.field(column)
    values = pa.array(change(table[column].to_pylist()), kind.type)
    parquet.write_table(table.set_column(place, kind, values), file)


def change_info(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change ``meta/info.json`` of a LeRobot dataset."""
    file = root / "meta" / "info.json"
    info = json.loads(file.read_text())
    change(info)
    file.write_text(json.dumps(info))


def tasks_of(root: Path) -> dict[int, str]:
    """Return the sentences of a LeRobot v3.0 dataset by number."""
    columns = parquet.read_table(root / "meta" / "tasks.parquet").to_pydict()
    numbers = columns.pop("task_index")
    (sentences,) = columns.values()
    return dict(zip(numbers, sentences, strict=True))


@contextmanager
def slow() -> Iterator[Scorer]:
    yield BrightnessScorer(0.05)


@contextmanager
def picky() -> Iterator[Scorer]:
    yield PickyScorer()


def brightness(frames: UInt8Array) -> np.ndarray[tuple[int], np.dtype[np.float32]]:
    return np.array([frame.mean() / 255 for frame in frames], np.float32)


def redness(frames: UInt8Array) -> np.ndarray[tuple[int], np.dtype[np.float32]]:
    return np.array([frame[..., 0].mean() / 255 for frame in frames], np.float32)


if __name__ == "__main__":
    source, output, seconds = sys.argv[1:]
    label(open_dataset(source), BrightnessScorer(float(seconds)), LabelOptions(output=Path(output), workers=2, **FEW))
