# SPDX-License-Identifier: MIT
"""Memory of long videos for a checkpoint without encoders: few videos, and no frame twice."""

from __future__ import annotations

import functools
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labelling import BrightnessScorer, ByCurve, PickyScorer
from rfm_client import UInt8Array
from rfm_client.frames import sampling
from rfm_labels import Dataset, DatasetEpisode, LabelOptions, Report, label, scoring
from rfm_labels.scoring import FrameMemory

NUM_FRAMES, SIDE = 1000, 48
VIDEO_BYTES = NUM_FRAMES * SIDE * SIDE * 3
WORKERS = 4


@pytest.fixture(autouse=True)
def small_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make requests small beside a video, as in reality."""
    monkeypatch.setattr(sampling, "MAX_BYTES", VIDEO_BYTES // 50)


class LongVideos(Dataset):
    """Episodes of a single camera with frames made on demand."""

    kind, source, cameras = "made up", "long videos", ("front",)

    def __init__(self, root: Path, num_episodes: int, num_more: int = 0) -> None:
        self.root, self.numbers, self.num_more = root, range(num_episodes), num_more

    def read_episode(self, number: int) -> DatasetEpisode:
        return DatasetEpisode(number, f"video {number}", "wait", NUM_FRAMES, number * NUM_FRAMES)

    def decoder(self, camera: str) -> None:
        return None

    def identity(self, episode: DatasetEpisode, camera: str) -> str:
        return str(episode.index)

    def check(self, episode: DatasetEpisode, camera: str) -> int:
        return VIDEO_BYTES

    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        return (np.full((SIDE, SIDE, 3), t % 256, np.uint8) for t in range(NUM_FRAMES + self.num_more))


def peak_videos(dataset: LongVideos, options: LabelOptions, scorer: BrightnessScorer) -> tuple[float, Report]:
    """The most memory that was held, in videos."""
    label(
        LongVideos(dataset.root, 1), BrightnessScorer(), LabelOptions(output=options.output, name="imports", frames=1)
    )
    tracemalloc.start()
    try:
        report = label(dataset, scorer, options)
        return tracemalloc.get_traced_memory()[1] / VIDEO_BYTES, report
    finally:
        tracemalloc.stop()


MODES: dict[str, tuple[type[BrightnessScorer], dict[str, Any]]] = {
    "prefixes": (BrightnessScorer, {"frames": 2}),
    "prefixes at once": (ByCurve, {"frames": 2}),
    "one pass": (BrightnessScorer, {"mode": "whole"}),
}


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "mode"), MODES.values(), ids=MODES)
def test_each_frame_of_a_video_is_held_once(output: Path, kind: type[BrightnessScorer], mode: dict[str, Any]) -> None:
    options = LabelOptions(output=output, workers=1, formats=("progress",), **mode)
    peak, report = peak_videos(LongVideos(output, 1), options, kind(max_frames=None))
    assert report.summary is not None
    assert report.summary.final_progress.tolist() == pytest.approx([(NUM_FRAMES - 1) % 256 / 255])
    assert 1 <= peak < 1.7


BOUNDS = {
    "of one and a half videos": (int(1.5 * VIDEO_BYTES), BrightnessScorer()),
    "below one video": (1, BrightnessScorer()),
    "and an episode that failed holds nothing": (int(1.5 * VIDEO_BYTES), PickyScorer("wait")),
}


@pytest.mark.slow
@pytest.mark.parametrize(("max_bytes", "scorer"), BOUNDS.values(), ids=BOUNDS)
def test_all_workers_together_hold_no_more_than_fits_or_one_video(
    output: Path, max_bytes: int, scorer: BrightnessScorer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scoring, "FrameMemory", functools.partial(FrameMemory, max_bytes))
    options = LabelOptions(output=output, workers=WORKERS, frames=2)
    peak, report = peak_videos(LongVideos(output, WORKERS), options, scorer)
    assert len(report.failures) == (WORKERS if isinstance(scorer, PickyScorer) else 0)
    assert 1 <= peak < 2


@pytest.mark.parametrize("num_more", [-1, 1])
def test_more_or_fewer_frames_than_rows_fail_the_episode(output: Path, num_more: int) -> None:
    report = label(LongVideos(output, 1, num_more), BrightnessScorer(), LabelOptions(output=output, frames=2))
    (failure,) = report.failures
    assert str(failure.error) == f"video 0: front: expected {NUM_FRAMES} frames, got {NUM_FRAMES + num_more}"
