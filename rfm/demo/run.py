# SPDX-License-Identifier: MIT
"""The demo itself: one sample of each type by embeddings over both protocols, one video by frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console

from rfm.demo.show import metrics_table, plot, scores_table
from rfm.models.rewind import RewindConfig
from rfm.server.process import Endpoints
from rfm_client import PreferenceSample, ProgressSample, RewardClient, Sample, SimilaritySample, Trajectory
from rfm_client.video import read_video

MAX_FRAMES = 16  # of a video; upstream's ReWiND checkpoints take 16
SAMPLE_FRAMES = 8
SEED = 0


def score_embeddings(endpoints: Endpoints, config: RewindConfig, console: Console) -> None:
    """Random embeddings, as one sample of each type, over gRPC and HTTP."""
    random = np.random.default_rng(SEED)
    first, second = (
        Trajectory(
            video_embeddings=random.standard_normal((SAMPLE_FRAMES, config.video_feature_dim), np.float32),
            text_embedding=random.standard_normal(config.text_feature_dim, np.float32),
        )
        for _ in range(2)
    )
    samples: dict[str, Sample] = {
        "progress": ProgressSample(first),
        "progress, dense": ProgressSample(first, frame_steps=4),
        "preference": PreferenceSample(first, second),
    }
    if config.has_similarity:
        samples["similarity"] = SimilaritySample(first, second)
    for url in (endpoints.grpc_url, endpoints.http_url):
        with RewardClient(url) as client:
            results = client.evaluate(list(samples.values()))
        console.print(scores_table(f"random embeddings over {url}", list(zip(samples, results, strict=True))))


def score_video(endpoints: Endpoints, video: Path, task: str, fps: float, picture: Path, console: Console) -> None:
    """A video's frames, at ``fps`` or so many fewer that they are MAX_FRAMES, and the picture of their scores."""
    frames = read_video(video, fps)
    if len(frames) > MAX_FRAMES:
        console.print(f"{video.name}: {len(frames)} frames at {fps:g} fps; {MAX_FRAMES} of them, evenly, are scored")
        frames = frames[np.linspace(0, len(frames) - 1, MAX_FRAMES).astype(np.int64)]
    with RewardClient(endpoints.grpc_url) as client:
        result = client.progress(Trajectory(frames=frames, task=task))
    console.print(scores_table(f'{video.name}: "{task}"', [("video", result)]))
    plot(picture, frames, result, f'"{task}"')
    console.print(f"plot: {picture}")


def show_metrics(endpoints: Endpoints, console: Console) -> None:
    """What Triton counted meanwhile."""
    console.print(metrics_table(endpoints.metrics_url))
