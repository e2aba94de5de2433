# SPDX-License-Identifier: MIT
"""A video's scores from a repository that is served for just so long. What ``rfm demo`` does."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn

from rich.console import Console

from rfm.server.installation import find_installation
from rfm.server.process import STOP_SIGNALS, Endpoints, TritonServer
from rfm_client import RewardClient, Trajectory
from rfm_client.show import Panel, plot, scores_table, status_tables
from rfm_client.status import read_status
from rfm_client.video import frame_times_s, read_video


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


@contextmanager
def served(repository: Path, log: Path, tritonserver: Path | None = None) -> Iterator[Endpoints]:
    """A server on free ports of this machine, with Triton's log in a file. Raises ServerStartError."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with (
        log.open("wb") as lines,
        TritonServer(repository, Endpoints.free(), find_installation(tritonserver), log=lines) as server,
    ):
        yield server.endpoints


def score_video(endpoints: Endpoints, video: Path, task: str, fps: float, picture: Path, console: Console) -> None:
    """Scores the video's frames at ``fps``, or as many, evenly, as the checkpoint takes, and draws a picture."""
    frames = read_video(video, fps)
    with RewardClient(endpoints.grpc_url) as client:
        result = client.progress(Trajectory(frames=frames, task=task), subsample=True)
    if len(result.progress) < len(frames):
        console.print(f"{video.name}: {len(result.progress)} of {len(frames)} frames, evenly, are scored")
    console.print(scores_table(f'"{task}"', [(video.name, result)]))
    plot(picture, [Panel.of(f'"{task}"', result, frames, frame_times_s(video, len(frames)))])
    console.print(f"plot: {picture}")


def show_metrics(endpoints: Endpoints, console: Console) -> None:
    """What Triton counted meanwhile."""
    console.print(*status_tables(read_status(endpoints.http_url, metrics_url=endpoints.metrics_url)), sep="\n")
