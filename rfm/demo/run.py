# SPDX-License-Identifier: MIT
"""The demo itself: one sample of each type by embeddings over both protocols, one video by frames."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn

import numpy as np
from rich.console import Console

from rfm.models.rewind import RewindConfig
from rfm.server.process import STOP_SIGNALS, Endpoints
from rfm_client import PreferenceSample, ProgressSample, RewardClient, Sample, SimilaritySample, Trajectory
from rfm_client.fit import evenly_spaced
from rfm_client.samples import UInt8Array
from rfm_client.show import Panel, plot, scores_table, status_tables
from rfm_client.status import read_status
from rfm_client.video import read_video

MAX_FRAMES = 16  # of a video; upstream's ReWiND checkpoints take 16
SAMPLE_FRAMES = 8
SEED = 0


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Within it a signal to stop raises SystemExit, so that whatever was started is stopped."""

    def leave(number: int, _frame: FrameType | None) -> NoReturn:
        raise SystemExit(128 + number)

    previous = {number: signal.signal(number, leave) for number in STOP_SIGNALS}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def score_embeddings(endpoints: Endpoints, config: RewindConfig, console: Console) -> None:
    """Random embeddings, as one sample of each type, over gRPC and HTTP."""
    random = np.random.default_rng(SEED)
    length = min(SAMPLE_FRAMES, config.max_frames or SAMPLE_FRAMES)
    first, second = (
        Trajectory(
            video_embeddings=random.standard_normal((length, config.video_feature_dim), np.float32),
            text_embedding=random.standard_normal(config.text_feature_dim, np.float32),
        )
        for _ in range(2)
    )
    samples: dict[str, Sample] = {
        "progress": ProgressSample(first),
        "progress, dense": ProgressSample(first, frame_steps=min(4, length)),
        "preference": PreferenceSample(first, second),
    }
    if config.has_similarity:
        samples["similarity"] = SimilaritySample(first, second)
    for url in (endpoints.grpc_url, endpoints.http_url):
        with RewardClient(url) as client:
            results = client.evaluate(list(samples.values()))
        console.print(scores_table(f"random embeddings over {url}", list(zip(samples, results, strict=True))))


def video_frames(video: Path, fps: float, max_frames: int | None, console: Console) -> UInt8Array:
    """uint8 [T, H, W, 3], the video's frames at ``fps``, or as many of them, evenly, as the checkpoint takes."""
    frames = read_video(video, fps)
    kept = evenly_spaced(len(frames), min(MAX_FRAMES, max_frames or MAX_FRAMES))
    if kept is None:
        return frames
    console.print(f"{video.name}: {len(frames)} frames at {fps:g} fps; {len(kept)} of them, evenly, are scored")
    return frames[kept]


def score_frames(endpoints: Endpoints, frames: UInt8Array, task: str, picture: Path, console: Console) -> None:
    """Frames [T, H, W, 3] over gRPC, and the picture of their scores."""
    with RewardClient(endpoints.grpc_url) as client:
        result = client.progress(Trajectory(frames=frames, task=task))
    console.print(scores_table(f'"{task}"', [("video", result)]))
    plot(picture, [Panel.of(f'"{task}"', result, frames)])
    console.print(f"plot: {picture}")


def show_metrics(endpoints: Endpoints, console: Console) -> None:
    """What Triton counted meanwhile."""
    console.print(*status_tables(read_status(endpoints.http_url, metrics_url=endpoints.metrics_url)), sep="\n")
