# SPDX-License-Identifier: MIT
"""The ``rfm`` command. The only place where packages meet that otherwise do not know of each other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console

from rfm.checkpoint import CheckpointError
from rfm.config import ConfigError, ServeConfig
from rfm.server.installation import ServerStartError, find_installation
from rfm.server.process import Endpoints, TritonServer
from rfm_client import RewardError

EXIT_FAILED = 1
WHEEL_WARNING = "the wheel's Triton 2.51 has known remote vulnerabilities and open admin APIs: use NVIDIA's container"

app = typer.Typer(
    name="rfm",
    help="Reward models for robot learning, served by Triton.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Config = Annotated[Path | None, typer.Option(help="YAML file of a ServeConfig; options given here win over it.")]
BaseModel = Annotated[
    str | None, typer.Option(help="Folder or id of a vision-language checkpoint's base model; else as it says itself.")
]
Repository = Annotated[Path, typer.Option(help="Triton model repository.")]
TritonPath = Annotated[
    Path | None, typer.Option("--tritonserver", help="tritonserver program; else PATH, else the nvidia-pytriton wheel.")
]


@app.command()
def export(
    repository: Repository,
    checkpoint: Annotated[str | None, typer.Option(help="Folder, or Hugging Face id org/name[@tag].")] = None,
    name: Annotated[str | None, typer.Option(help="Model name in the repository (rfm).")] = None,
    config: Config = None,
    image_encoder: Annotated[str | None, typer.Option(help="Folder or id of ReWiND's image encoder.")] = None,
    text_encoder: Annotated[str | None, typer.Option(help="Folder or id of ReWiND's text encoder.")] = None,
    base_model: BaseModel = None,
    check: Annotated[bool, typer.Option("--check", help="Write nothing; compare with what would be written.")] = False,
) -> None:
    """Write a checkpoint into a model repository as the next version of its models."""
    import rfm_export

    serve = _serve_config(
        config,
        model_path=checkpoint,
        name=name,
        image_encoder=image_encoder,
        text_encoder=text_encoder,
        base_model=base_model,
    )
    try:
        if check:
            differences = rfm_export.check(repository, serve)
            if differences:
                _fail("\n".join(differences))
            typer.echo(f"{repository}: as generated")
            return
        if serve.model_path is None:
            _fail("--checkpoint: expected a checkpoint, here or as model_path in --config, got none")
        version = rfm_export.export(serve.model_path, repository, serve)
    except (CheckpointError, rfm_export.ExportError, OSError) as error:
        _fail(str(error))
    typer.echo(f"{repository}: {serve.name} version {version}, scores equal to the checkpoint's")


@app.command()
def serve(
    repository: Repository,
    config: Config = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on (127.0.0.1).")] = None,
    http_port: Annotated[int | None, typer.Option(help="HTTP port (8000).")] = None,
    grpc_port: Annotated[int | None, typer.Option(help="gRPC port (8001).")] = None,
    metrics_port: Annotated[int | None, typer.Option(help="Port of the Prometheus metrics (8002).")] = None,
    tritonserver: TritonPath = None,
) -> None:
    """Run tritonserver on a model repository until it is told to stop."""
    settings = _serve_config(
        config, server_url=host, server_port=http_port, grpc_port=grpc_port, metrics_port=metrics_port
    )
    try:
        installation = find_installation(tritonserver)
        if installation.wheel is not None and not settings.is_loopback:
            typer.echo(f"rfm: warning: {settings.host} is no loopback address, and {WHEEL_WARNING}", err=True)
        server = TritonServer(repository, Endpoints.of(settings), installation, http_threads=settings.max_workers)
        status = server.run()
    except ServerStartError as error:
        _fail(str(error))
    raise typer.Exit(status)


@app.command()
def demo(
    video: Annotated[Path | None, typer.Option(help="Video file to score; else a clip that is rendered here.")] = None,
    task: Annotated[str | None, typer.Option(help="What is to be done in the video, as a sentence.")] = None,
    fps: Annotated[float, typer.Option(help="Frames a second that are scored.")] = 3.0,
    checkpoint: Annotated[str | None, typer.Option(help="Checkpoint to serve; else one with random weights.")] = None,
    image_encoder: Annotated[str | None, typer.Option(help="Folder or id of its image encoder.")] = None,
    text_encoder: Annotated[str | None, typer.Option(help="Folder or id of its text encoder.")] = None,
    base_model: BaseModel = None,
    output: Annotated[Path, typer.Option(help="Folder for the plot and Triton's log.")] = Path("demo_output"),
    tritonserver: TritonPath = None,
) -> None:
    """Export a checkpoint, serve it, score samples and a video, plot, and stop everything."""
    import rfm_export
    from rfm import checkpoint as checkpoints
    from rfm.models.rewind import RewindConfig

    try:
        from rfm.demo import clip, run
        from rfm.demo.checkpoint import write_random_checkpoint
    except ImportError as error:
        _fail(f'the demo needs {error.name}: pip install "rfm-triton[demo,encoders,triton]"')
    if (video is None) != (task is None):
        _fail("--video and --task: expected both or neither, got one")
    console = Console()
    output.mkdir(parents=True, exist_ok=True)
    with run.stopped_by_signals(), TemporaryDirectory(prefix="rfm-demo-") as folder:
        if checkpoint is None:
            console.print("The checkpoint has random weights: its scores show that all is connected, and mean nothing.")
            checkpoint, image_encoder, text_encoder = map(str, write_random_checkpoint(Path(folder) / "random"))
        settings = _serve_config(None, image_encoder=image_encoder, text_encoder=text_encoder, base_model=base_model)
        repository = Path(folder) / "model_repository"
        if video is None or task is None:
            video, task = Path(folder) / "clip.mp4", clip.TASK
            clip.write(video)
        try:
            config = checkpoints.load(checkpoint, base_model=base_model).config
            rewind = config if isinstance(config, RewindConfig) else None
            frames = run.video_frames(video, fps, rewind.max_frames if rewind else None, console)
            rfm_export.export(checkpoint, repository, settings)
            with (
                (output / "tritonserver.log").open("wb") as log,
                TritonServer(repository, Endpoints.free(), find_installation(tritonserver), log=log) as server,
            ):
                if rewind is not None:
                    run.score_embeddings(server.endpoints, rewind, console)
                if (repository / f"{settings.name}_frames").exists():
                    run.score_frames(server.endpoints, frames, task, output / "rewards.png", console)
                else:
                    console.print("no video: the checkpoint has no encoders (--image-encoder, --text-encoder)")
                run.show_metrics(server.endpoints, console)
        except (CheckpointError, rfm_export.ExportError, ServerStartError, RewardError) as error:
            _fail(str(error))


def _serve_config(file: Path | None, **options: Any) -> ServeConfig:
    """The file's configuration with the options that were given on the command line."""
    try:
        config = ServeConfig() if file is None else ServeConfig.from_yaml(file)
        return replace(config, **{key: value for key, value in options.items() if value is not None})
    except ConfigError as error:
        _fail(str(error))


def _fail(message: str) -> NoReturn:
    typer.echo(f"rfm: {message}", err=True)
    raise typer.Exit(EXIT_FAILED)


def main() -> None:
    """Entry point of the ``rfm`` console script."""
    app()
