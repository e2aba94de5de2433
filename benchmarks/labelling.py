# SPDX-License-Identifier: MIT
"""What labelling costs beside the scorer: memory over long datasets, frames a second, Ray actors.

python benchmarks/labelling.py             # all, a few minutes; writes results/labelling.json
python benchmarks/labelling.py one FOLDER  # labels a dataset and prints its peak memory; what `memory` starts

The scorer is simulated: a fixed time for each request, one request at a time, as one GPU would answer.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pyarrow import parquet

from rfm_client import ProgressResult, ProgressSample, Trajectory
from rfm_client.contract.samples import UInt8Array
from rfm_client.labelling import (
    CheckpointFacts,
    Dataset,
    DatasetEpisode,
    LabelOptions,
    RayOptions,
    Scorer,
    Watch,
    label,
    label_with_ray,
    open_dataset,
)

HERE = Path(__file__).parent
TOY = HERE.parent / "tests" / "lerobot" / "toy_v21"
RESULTS = HERE / "results" / "labelling.json"
SHORT, LONG = 4, 80  # repetitions of the toy dataset: the second is 20 times as long
REQUEST_S = 0.05
RAY_REQUEST_S = 0.5
RAY_TIMES = 12  # repetitions of the toy dataset
FRAMES = 16
ACTORS = 8


class SimulatedScorer:
    """Takes a fixed time for each request. encodes: it scores embeddings of 64 numbers, which take no time to make"""

    def __init__(self, seconds: float, *, encodes: bool) -> None:
        self._seconds, self._encodes = seconds, encodes
        self._lock = threading.Lock()

    def checkpoint(self) -> CheckpointFacts:
        """The facts of a checkpoint that does not exist."""
        return CheckpointFacts("simulated", None, "simulated", "simulated", FRAMES, None, self._encodes, False)

    def encode(self, frames: UInt8Array, task: str) -> Trajectory:
        """The brightness of each frame."""
        brightness = frames[:, ::16, ::16].mean(axis=(1, 2, 3), dtype=np.float32)
        return Trajectory(video_embeddings=np.repeat(brightness[:, None], 64, axis=1), text_embedding=np.ones(8))

    def evaluate(self, samples: Sequence[ProgressSample]) -> list[ProgressResult]:
        """Zeros, after a while."""
        with self._lock:
            time.sleep(self._seconds)
        zeros = [np.zeros(sample.trajectory.num_frames, np.float32) for sample in samples]
        return [ProgressResult(progress=zero, success=zero) for zero in zeros]


class InMemory:
    """A dataset whose frames are decoded before the clock starts."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._frames = {
            (episode.index, camera): list(dataset.frames(episode, camera))
            for episode in dataset.episodes
            for camera in dataset.cameras
        }

    def __getattr__(self, name: str) -> Any:
        return getattr(self._dataset, name)

    @cached_property
    def episodes(self) -> Sequence[DatasetEpisode]:
        """All episodes of the dataset."""
        return self._dataset.episodes

    def frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        """The frames, decoded before."""
        return iter(self._frames[episode.index, camera])


@contextmanager
def simulated() -> Iterator[Scorer]:
    """The scorer of a Ray actor."""
    yield SimulatedScorer(RAY_REQUEST_S, encodes=True)


def repeated(folder: Path, times: int) -> Path:
    """The toy dataset so many times, as one of LeRobot v2.1 whose films are links."""
    shutil.copytree(TOY, folder)
    info = json.loads((folder / "meta" / "info.json").read_text())
    lines = [json.loads(line) for line in (folder / "meta" / "episodes.jsonl").read_text().splitlines()]
    count, num_frames = info["total_episodes"], info["total_frames"]
    more = []
    for index in range(count * times):
        more.append({**lines[index % count], "episode_index": index})
        if index < count:
            continue
        for pattern in ("data/chunk-000/episode_{:06d}.parquet", *_films(info)):
            original, copy = (folder / pattern.format(number) for number in (index % count, index))
            if copy.suffix == ".mp4":
                copy.symlink_to(original)
            else:
                _renumbered(original, copy, index, num_frames * (index // count))
    info |= {"total_episodes": count * times, "total_frames": num_frames * times, "chunks_size": 100_000}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    (folder / "meta" / "episodes.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in more))
    return folder


def _films(info: dict[str, Any]) -> list[str]:
    cameras = [key for key, feature in info["features"].items() if feature["dtype"] == "video"]
    return [f"videos/chunk-000/{camera}/episode_{{:06d}}.mp4" for camera in cameras]


def _renumbered(original: Path, copy: Path, index: int, offset: int) -> None:
    table = parquet.read_table(original, partitioning=None)
    for name, values in (
        ("index", table["index"].to_numpy() + offset),
        ("episode_index", np.full(len(table), index, np.int64)),
    ):
        table = table.set_column(table.schema.get_field_index(name), name, [values])
    parquet.write_table(table, copy)


def labelled_s(dataset: Dataset, scorer: Scorer, output: Path) -> float:
    """Seconds that labelling takes, the check of the dataset left out."""
    output.mkdir()
    marks: list[float] = []

    class Clock(Watch):
        def begin(self, num_frames: int, num_finished: int) -> None:
            marks.append(time.monotonic())

    label(dataset, scorer, LabelOptions(output=output), Clock())
    return time.monotonic() - marks[0]


def memory(folder: Path) -> dict[str, float]:
    """MiB that a process needs at most to label datasets of two lengths."""
    peaks = {}
    for times in (SHORT, LONG):
        dataset = repeated(folder / f"times_{times}", times)
        told = subprocess.run(
            [sys.executable, __file__, "one", dataset], check=True, capture_output=True, text=True
        ).stdout
        peaks[f"{times} times the toy dataset: peak MiB"] = float(told)
    return peaks


def throughput(folder: Path) -> dict[str, float]:
    """Frames a second from the dataset, and of the scorer alone on frames in memory."""
    dataset = open_dataset(repeated(folder / "throughput", SHORT))
    num_frames = sum(episode.num_frames for episode in dataset.episodes)
    figures = {}
    for name, encodes in (("embeddings", True), ("raw frames", False)):
        rates = []
        for number, source in enumerate((InMemory(dataset), dataset)):
            scorer = SimulatedScorer(REQUEST_S, encodes=encodes)
            rates.append(num_frames / labelled_s(source, scorer, folder / f"{name} {number}"))
        figures |= {f"{name}: frames/s in memory": rates[0], f"{name}: frames/s from films": rates[1]}
        figures[f"{name}: share"] = rates[1] / rates[0]
    return figures


class Arrivals(Watch):
    """When each episode was labelled, and how many frames it has."""

    def __init__(self) -> None:
        self._arrivals: list[tuple[float, int]] = []

    def scored(self, episode: DatasetEpisode) -> None:
        """Notes the time."""
        self._arrivals.append((time.monotonic(), episode.num_frames))

    def frames_per_s(self) -> float:
        """The rate of the middle half of the episodes: all actors run, and none has ended."""
        quarter = len(self._arrivals) // 4
        (began_s, _), *arrivals = self._arrivals[quarter:-quarter]
        return sum(num_frames for _, num_frames in arrivals) / (arrivals[-1][0] - began_s)


def actors(folder: Path) -> dict[str, float]:
    """How much faster 8 Ray actors are than one, where a request takes a fixed time."""
    import ray

    source = str(repeated(folder / "ray", RAY_TIMES))
    rates, took_s = {}, {}
    ray.init(num_cpus=ACTORS, include_dashboard=False, log_to_driver=False)
    for count in (1, ACTORS):
        output = folder / f"actors_{count}"
        output.mkdir()
        arrivals = Arrivals()
        began_s = time.monotonic()
        label_with_ray(
            source, simulated, LabelOptions(output=output, workers=1), arrivals, ray=RayOptions(actors=count)
        )
        took_s[count], rates[count] = time.monotonic() - began_s, arrivals.frames_per_s()
    ray.shutdown()
    return {
        "1 actor: frames/s": rates[1],
        f"{ACTORS} actors: frames/s": rates[ACTORS],
        "share": rates[ACTORS] / rates[1] / ACTORS,
        "1 actor: s in all": took_s[1],
        f"{ACTORS} actors: s in all, their start and end included": took_s[ACTORS],
    }


def main() -> None:
    """Measures all, and prints and writes the figures."""
    if sys.argv[1:2] == ["one"]:
        with tempfile.TemporaryDirectory() as output:
            label(open_dataset(sys.argv[2]), SimulatedScorer(0.0, encodes=True), LabelOptions(output=Path(output)))
        (peak_kib,) = re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
        print(int(peak_kib) / 1024)  # of this process alone: getrusage would tell its parent's, if that was larger
        return
    with tempfile.TemporaryDirectory() as folder:
        figures = {measure.__name__: measure(Path(folder)) for measure in (memory, throughput, actors)}
    rounded = {name: {key: round(value, 3) for key, value in part.items()} for name, part in figures.items()}
    text = json.dumps(rounded, indent=2)
    RESULTS.write_text(f"{text}\n")
    print(text)


if __name__ == "__main__":
    main()
