# SPDX-License-Identifier: MIT
"""A video's scores from a server, as a table and a picture. What ``rfm demo`` shows."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from rfm.launch.process import Endpoints
from rfm_client import RewardClient, Trajectory
from rfm_client.cli.show import Panel, plot, scores_table, status_tables
from rfm_client.contract.samples import UInt8Array
from rfm_client.data.video import frame_times_s
from rfm_client.transport.status import read_status


def score_video(
    endpoints: Endpoints, video: Path, frames: UInt8Array, task: str, picture: Path, console: Console
) -> None:
    """Scores the video's frames, or as many, evenly, as the checkpoint takes, and draws a picture."""
    with RewardClient(endpoints.grpc_url) as client:
        result = client.progress(Trajectory(frames=frames, task=task), subsample=True)
    if len(result.progress) < len(frames):
        console.print(f"{video.name}: {len(result.progress)} of {len(frames)} frames, evenly, are scored")
    console.print(scores_table(f'"{task}"', [(video.name, result)]))
    plot(picture, [Panel.of(f'"{task}"', result, frames, frame_times_s(video, len(frames)))])
    console.print(f"plot: {picture}")


def show_metrics(endpoints: Endpoints, console: Console) -> None:
    """Prints what Triton counted while the demo ran."""
    status = read_status(endpoints.http_url, metrics_url=endpoints.metrics_url)
    console.print(*status_tables(status), sep="\n", markup=False, highlight=False)
