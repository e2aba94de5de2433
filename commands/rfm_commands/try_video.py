# SPDX-License-Identifier: MIT
"""``rfm try``: a video's scores from a temporary server, as a table and a plot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from rfm.config import CheckpointConfig, ExportConfig
from rfm.serve.access import Endpoints
from rfm.serve.repository import models_in, no_models
from rfm.serve.triton_server import stopped_by_signals, temporary_server
from rfm_client import RewardClient, Trajectory
from rfm_client.cli.command import OptionValues, with_options
from rfm_client.cli.options import FrameRate
from rfm_client.cli.show import PAGE_PORT, PAGE_URL, command, next_steps, scores_table
from rfm_client.contract.checks import is_blank
from rfm_client.contract.description import PUBLIC_CHECKPOINT, ModelInfo
from rfm_client.contract.samples import UInt8Array
from rfm_client.contract.wire import frames_name
from rfm_commands.cached_export import exported
from rfm_commands.command import TritonPath, fail

REPOSITORY = Path("model_repository")
HOW_GOOD = "docs/guides/how_good_is_it.md"


@with_options
def try_video(
    video: Annotated[Path, typer.Argument(metavar="VIDEO", help="Video file to score.")],
    task: Annotated[str, typer.Option(help="The task, as a sentence.")],
    rate: FrameRate,
    given: OptionValues[CheckpointConfig],
    repository: Annotated[Path, typer.Option(help="Repository to serve, if no checkpoint is given.")] = REPOSITORY,
    output: Annotated[Path, typer.Option(help="Folder for the plot and Triton's log.")] = Path("demo_output"),
    tritonserver: TritonPath = None,
) -> None:
    """Serve a checkpoint, score one video, plot, and stop.

    Example: rfm try video.mp4 --task "open the drawer" --checkpoint org/name
    """
    try:
        import av  # noqa: F401  ``read_video`` needs it

        from rfm_client.frames.video import read_video
    except ImportError as error:
        fail(f'it needs {error.name}: pip install ".[demo,encoders,vlm,triton]"')
    if is_blank(task):
        raise typer.BadParameter(f"expected a sentence, got {task!r}", param_hint="'--task'")
    settings = ExportConfig(**given)
    if settings.checkpoint is None and not models_in(repository):
        fail(f"{no_models(repository)}; --checkpoint {PUBLIC_CHECKPOINT} serves a public checkpoint")
    with stopped_by_signals():
        frames = read_video(video, rate.fps)
        try:
            output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            fail(f"{output}: expected a folder that can be made, got: {error.strerror}; --output names another one")
        served = repository if settings.checkpoint is None else _exported_frames(settings)
        with temporary_server(served, output / "tritonserver.log", tritonserver) as endpoints:
            info = score_video(endpoints, video, frames, task, output)
    source = [repository] if settings.checkpoint is None else [settings.checkpoint, *_words(given)]
    steps = steps_without_server(source, video, task)
    if info.warning:
        public = command("rfm", "try", video, "--task", task, "--checkpoint", PUBLIC_CHECKPOINT)
        steps.insert(0, ("score the video with a public checkpoint", public))
    else:
        install = command("pip", "install", "-c", "constraints.txt", "./apps/labels")
        measure = command("rfm-client", "evaluate", "DATASET", "--outcome", "outcomes.csv")
        steps += [
            (f"is it right on your robot? measure it ({HOW_GOOD})", install),
            ("label episodes, while the model is served", command("rfm-client", "label", "DATASET")),
            ("compare labels with outcomes", measure),
        ]
    typer.echo(next_steps(*steps))


def steps_without_server(source: Sequence[object], video: Path, task: str) -> list[tuple[str, str]]:
    """Return what to try with a video: serve the model with the page, score the video.

    source: a repository, or a checkpoint and its options
    """
    served = command("rfm", "serve", *source, "--gateway-port", PAGE_PORT)
    score = command("rfm-client", "score", video, "--task", task)
    return [(f"serve the model, and the page at {PAGE_URL}", served), ("in another terminal, score the video", score)]


def score_video(endpoints: Endpoints, video: Path, frames: UInt8Array, task: str, output: Path) -> ModelInfo:
    """Score the video, print the table, draw the plot, and describe the model.

    frames: uint8 [T, H, W, 3], T frames, H x W pixels, evenly thinned if the checkpoint takes fewer
    output: folder for the plot, whose name holds those of video and checkpoint
    """
    from rfm_client.cli.pictures import Panel, plot
    from rfm_client.cli.scoring import checkpoint_name, heading
    from rfm_client.frames.video import frame_times_s

    with RewardClient(endpoints.grpc_url) as client:
        trajectory = Trajectory(frames=frames, task=task)
        result = client.progress(trajectory, subsample=True)
        info = client.model_info(frames=True)
    if len(result.progress) < len(frames):
        typer.echo(f"{video.name}: {len(result.progress)} of {len(frames)} frames are scored, evenly spaced")
    name = checkpoint_name(info)
    print(scores_table(f'"{task}", scored by {name}', [(video.name, result)]))
    if info.warning:
        typer.echo(f"note: {info.warning}")
    title = heading(task, [info])
    picture = output / f"{video.stem}.{name.replace('/', '.')}.png"
    plot(picture, [Panel.of(video.name, result, frames, frame_times_s(video, len(frames)))], title)
    typer.echo(f"The curves are in {picture}.")
    return info


def _exported_frames(settings: ExportConfig) -> Path:
    """Return the repository of the checkpoint's export. Fails if the checkpoint scores only embeddings."""
    repository = exported(settings)
    if not (repository / frames_name(settings.name)).exists():
        fail(f"{settings.checkpoint}: expected one that scores frames, got none; name --image-encoder, --text-encoder")
    return repository


def _words(given: OptionValues[CheckpointConfig]) -> list[str]:
    """Return a checkpoint's options, as they stand on a command line behind the checkpoint."""
    words = []
    for name, value in given.items():
        option = CheckpointConfig.settings()[name].option
        words += [] if name == "checkpoint" else [option] if value is True else [option, str(value)]
    return words
