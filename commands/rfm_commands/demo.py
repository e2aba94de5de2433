# SPDX-License-Identifier: MIT
"""``rfm demo``: a video's scores from a temporary server, as a table and a plot."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from rfm.config import CheckpointConfig, ExportConfig
from rfm.launch.endpoints import Endpoints
from rfm.launch.temporary import stopped_by_signals, temporary_server
from rfm_client import RewardClient, Trajectory
from rfm_client.cli.command import Given, with_options
from rfm_client.cli.options import FrameRate
from rfm_client.cli.show import scores_table, status_tables
from rfm_client.contract.names import frames_name
from rfm_client.contract.samples import UInt8Array
from rfm_client.transport.status import ServerStatus
from rfm_commands.command import TritonPath, fail

if TYPE_CHECKING:
    from rich.console import Console

REPOSITORY = Path("model_repository")


@with_options
def demo(
    video: Annotated[Path, typer.Option(help="Video file to score.")],
    task: Annotated[str, typer.Option(help="The task, as a sentence.")],
    rate: FrameRate,
    given: Given[CheckpointConfig],
    repository: Annotated[Path, typer.Option(help="Repository to serve, if no checkpoint is given.")] = REPOSITORY,
    output: Annotated[Path, typer.Option(help="Folder for the plot and Triton's log.")] = Path("demo_output"),
    tritonserver: TritonPath = None,
) -> None:
    """Serve a checkpoint, score one video, plot, and stop everything."""
    try:
        import av  # noqa: F401  ``read_video`` needs it
        from rich.console import Console

        from rfm_client.frames.video import read_video
    except ImportError as error:
        fail(f'the demo needs {error.name}: pip install ".[demo,encoders,triton]"')
    console, settings = Console(), ExportConfig(**given)
    with stopped_by_signals(), TemporaryDirectory(prefix="rfm-demo-") as folder:
        frames = read_video(video, rate.fps)
        try:
            output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            fail(f"{output}: expected a folder that can be made, got: {error.strerror}; --output names another one")
        if settings.checkpoint is not None:
            repository = _exported_frames(settings.checkpoint, settings, Path(folder) / "model_repository")
        with temporary_server(repository, output / "tritonserver.log", tritonserver) as endpoints:
            score_video(endpoints, video, frames, task, output / "rewards.png", console)
            show_metrics(endpoints, console)


def score_video(
    endpoints: Endpoints, video: Path, frames: UInt8Array, task: str, picture: Path, console: Console
) -> None:
    """Score the video, print the table, and draw the plot.

    frames: uint8 [T, H, W, 3], T frames of H x W pixels, evenly thinned if the checkpoint takes fewer
    """
    from rfm_client.cli.pictures import Panel, plot
    from rfm_client.cli.scoring import checkpoint_of, heading
    from rfm_client.frames.video import frame_times_s

    with RewardClient(endpoints.grpc_url) as client:
        trajectory = Trajectory(frames=frames, task=task)
        result = client.progress(trajectory, subsample=True)
        title = heading(task, [checkpoint_of(client, trajectory)])
    if len(result.progress) < len(frames):
        console.print(f"{video.name}: {len(result.progress)} of {len(frames)} frames, evenly, are scored")
    console.print(scores_table(f'"{task}"', [(video.name, result)]))
    plot(picture, [Panel.of(video.name, result, frames, frame_times_s(video, len(frames)))], title)
    console.print(f"plot: {picture}")


def show_metrics(endpoints: Endpoints, console: Console) -> None:
    """Print Triton's counts of the demo's requests."""
    status = ServerStatus.read(endpoints.http_url, metrics_url=endpoints.metrics_url)
    console.print(*status_tables(status), sep="\n", markup=False, highlight=False)


def _exported_frames(checkpoint: str, settings: ExportConfig, repository: Path) -> Path:
    """Export the checkpoint, and return the repository. Fails if the checkpoint scores only embeddings."""
    import rfm_export

    rfm_export.export(checkpoint, repository, settings)
    if not (repository / frames_name(settings.name)).exists():
        fail(f"{checkpoint}: expected one that scores frames, got none; name --image-encoder, --text-encoder")
    return repository
