# SPDX-License-Identifier: MIT
"""LeRobot episodes with several tasks: one task per stretch of frames, or the first for all."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

from labelling import LEROBOT, WRIST, BrightnessScorer, ByCurve, Notes, change_column, tasks_of
from rfm_client import ProgressResult, ProgressSample, Trajectory, UInt8Array
from rfm_labels import CheckpointFacts, DatasetError, LabelOptions, label, open_dataset, read_episode_labels
from rfm_labels.advantage import recap_advantages

CUTS = (0, 20, 30)  # first frames of the stretches of episode 0
TASKS = (0, 4, 0)  # and numbers


class SinceTheFirst(BrightnessScorer):
    """Progress is the gain in brightness since the first visible frame. Keeps the samples' tasks."""

    def __init__(self, encodes: bool = False) -> None:
        super().__init__()
        self.encodes = encodes
        self.asked: list[str] = []

    def checkpoint(self) -> CheckpointFacts:
        return replace(super().checkpoint(), encodes=self.encodes)

    def encode(self, frames: UInt8Array, task: str) -> Trajectory:
        self.asked.append(task)
        embeddings = frames.reshape(len(frames), -1).mean(axis=1, dtype=np.float32)[:, None]
        return Trajectory(video_embeddings=embeddings, text_embedding=np.zeros(1, np.float32))

    def evaluate(self, samples: Sequence[ProgressSample]) -> list[ProgressResult]:
        self.asked += [sample.trajectory.task for sample in samples if sample.trajectory.task]
        return super().evaluate(samples)

    def _result(self, sample: ProgressSample) -> ProgressResult:
        shown = sample.trajectory.positions
        means = shown.reshape(len(shown), -1).mean(axis=1, dtype=np.float32) / 255
        return ProgressResult(progress=means - means[0], success=means)


class SinceTheFirstByCurve(ByCurve, SinceTheFirst):
    """Is asked for all prefixes of a stretch at once."""


class Rising(BrightnessScorer):
    """Progress rises from 0.1 to 0.9 over the frames of a sample."""

    def _result(self, sample: ProgressSample) -> ProgressResult:
        rising = np.linspace(0.1, 0.9, len(sample.trajectory.positions), dtype=np.float32)
        return ProgressResult(progress=rising, success=rising)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Episode 0 has two tasks in three stretches, all other episodes have one."""
    root = shutil.copytree(LEROBOT / "toy_v30_many", tmp_path / "toy")
    rows = root / "data" / "chunk-000" / "file-000.parquet"
    change_column(rows, "task_index", lambda values: [*numbers(58), *values[58:]])
    sentences = tasks_of(root)
    episodes = root / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    change_column(episodes, "tasks", lambda values: [[sentences[0], sentences[4]], *values[1:]])
    return root


def numbers(count: int) -> list[int]:
    return [TASKS[max(k for k, cut in enumerate(CUTS) if cut <= t)] for t in range(count)]


def options(output: Path, **more: Any) -> LabelOptions:
    few: dict[str, Any] = {"cameras": (WRIST,), "episodes": [0, 1], "frames": 4, "formats": ("progress",)}
    return LabelOptions(output=output, **{**few, **more})


@pytest.mark.parametrize("encodes", [False, True])
@pytest.mark.parametrize(
    ("mode", "kind"), [("prefix", SinceTheFirst), ("prefix", SinceTheFirstByCurve), ("whole", SinceTheFirst)]
)
def test_each_stretch_of_frames_is_scored_as_an_episode_of_its_task(
    root: Path, output: Path, mode: Any, kind: type[SinceTheFirst], encodes: bool
) -> None:
    dataset, notes, scorer = open_dataset(root), Notes(), kind(encodes)
    scorer.max_frames = None
    sentences = tasks_of(root)
    first = dataset.episode(0)
    assert (first.task, first.tasks) == (
        sentences[0],
        tuple((cut, sentences[t]) for cut, t in zip(CUTS, TASKS, strict=True)),
    )
    report = label(dataset, scorer, options(output, mode=mode, frames=4 if mode == "prefix" else None), notes)
    table = parquet.read_table(report.files[0])
    means = np.array([frame.mean() / 255 for frame in dataset.frames(first, WRIST)], np.float32)
    since = np.array([means[max(cut for cut in CUTS if cut <= t)] for t in range(len(means))])
    np.testing.assert_allclose(table["progress"].to_numpy()[: len(means)], means - since, atol=1e-5)
    assert table["frame_index"].to_pylist()[: len(means)] == list(range(len(means)))
    assert set(scorer.asked) == {sentences[0], sentences[4], dataset.episode(1).task}
    assert [line for line in notes.lines if line.startswith("tasks: they change within 1 episode: each stretch")]


def gains(table: Any, chunk: int) -> list[float]:
    """Return the progress per frame that LeRobot's reward-aligned cloning reads; below 0 the weight is 0."""
    progress, episodes = table["progress_sparse"].to_numpy(), table["episode_index"].to_numpy()
    last = {episode: int(np.flatnonzero(episodes == episode)[-1]) for episode in set(episodes.tolist())}
    return [float(progress[min(i + chunk, last[episodes[i]])] - progress[i]) for i in range(len(progress))]


@pytest.mark.parametrize("chunk", [1, 10, 50])
def test_frames_before_a_change_of_tasks_keep_their_weight_in_behaviour_cloning(
    root: Path, output: Path, chunk: int
) -> None:
    notes = Notes()
    chosen = options(output, mode="whole", frames=None, formats=("progress", "signals"), alias="sarm_progress")
    scorer = Rising(max_frames=None)
    report = label(open_dataset(root), scorer, chosen, notes)
    assert [
        line for line in notes.lines if line.startswith("progress_sparse: the sum of the gains in an episode's tasks")
    ]
    named, alias, signals = map(parquet.read_table, report.files)
    assert named.equals(alias)
    assert min(gains(named, chunk)) >= 0
    lengths = np.diff([*CUTS, 58])
    own = np.concatenate([np.linspace(0.1, 0.9, length, dtype=np.float32) for length in lengths])
    begins = np.repeat([0.1, 0.9, 1.7], lengths)
    np.testing.assert_array_equal(named["progress"].to_numpy()[:58], own)
    np.testing.assert_allclose(named["progress_sparse"].to_numpy()[:58], begins + own - 0.1, atol=1e-6)
    np.testing.assert_array_equal(named["progress_sparse"].to_numpy()[58:], named["progress"].to_numpy()[58:])
    np.testing.assert_array_equal(signals["reward.rfm.progress"].to_numpy(), named["progress"].to_numpy())
    shown = read_episode_labels(report.files[0], 0)
    assert shown is not None
    np.testing.assert_array_equal(shown.fused.progress, own)


def test_advantages_follow_recap_within_each_stretch_of_frames(root: Path, output: Path) -> None:
    # By hand: 4 steps in the task's longest episode, horizon 2. A(0) = 0.5 - 0.1 - 2/4, ..., A(2) = 0.3 - 0.5 - 1/4.
    progress = np.array([0.1, 0.2, 0.5, 0.3], np.float32)
    np.testing.assert_allclose(recap_advantages(progress, 2, 4), [-0.1, -0.4, -0.45, 0.0], atol=1e-7)

    chosen = options(output, mode="whole", frames=None, formats=("progress", "signals"), advantage=5)
    label(open_dataset(root), Rising(max_frames=None), replace(chosen, advantage=None))  # may be added later
    report = label(open_dataset(root), Rising(max_frames=None), chosen)
    table, signals = map(parquet.read_table, report.files)
    advantages, length, horizon = table["advantage"].to_numpy(), 20, 5
    left = np.minimum(horizon, length - 1 - np.arange(length))  # steps, fewer at the end of the first stretch
    steps = 58 - 30 - 1  # in the third stretch, the longest of the first task
    np.testing.assert_allclose(advantages[:length], left * (0.8 / (length - 1) - 1 / steps), atol=1e-6)
    np.testing.assert_array_equal(signals["reward.rfm.advantage"].to_numpy(), advantages)
    for other, message in ((7, r"advantage\.frames: 5 there, 7 now"), (None, r"advantage\.frames: 5 there, none now")):
        with pytest.raises(DatasetError, match=message):
            label(open_dataset(root), Rising(max_frames=None), replace(chosen, advantage=other))
