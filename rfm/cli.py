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
from rfm_client.gateway.command import gateway, gateway_command

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
    gateway_port: Annotated[
        int | None, typer.Option(help="Port of the FastAPI evaluation server's endpoints, too (see rfm gateway).")
    ] = None,
    tritonserver: TritonPath = None,
) -> None:
    """Run tritonserver on a model repository until it is told to stop."""
    settings = _serve_config(
        config,
        server_url=host,
        server_port=http_port,
        grpc_port=grpc_port,
        metrics_port=metrics_port,
        gateway_port=gateway_port,
    )
    try:
        installation = find_installation(tritonserver)
        if installation.wheel is not None and not settings.is_loopback:
            typer.echo(f"rfm: warning: {settings.host} is no loopback address, and {WHEEL_WARNING}", err=True)
        endpoints = Endpoints.of(settings)
        companion = None
        if settings.gateway_port is not None:
            companion = gateway_command(
                endpoints.grpc_url, endpoints.metrics_url, settings.name, settings.host, settings.gateway_port
            )
        server = TritonServer(repository, endpoints, installation, http_threads=settings.max_workers)
        status = server.run(companion)
    except ServerStartError as error:
        _fail(str(error))
    raise typer.Exit(status)


app.command()(gateway)


@app.command()
def demo(
    video: Annotated[Path, typer.Option(help="Video file to score.")],
    task: Annotated[str, typer.Option(help="What is to be done in the video, as a sentence.")],
    fps: Annotated[float, typer.Option(help="Frames a second that are scored.")] = 3.0,
    repository: Annotated[Path, typer.Option(help="Triton model repository.")] = Path("model_repository"),
    checkpoint: Annotated[str | None, typer.Option(help="Folder or id to export and serve, instead.")] = None,
    image_encoder: Annotated[str | None, typer.Option(help="Folder or id of its image encoder.")] = None,
    text_encoder: Annotated[str | None, typer.Option(help="Folder or id of its text encoder.")] = None,
    base_model: BaseModel = None,
    output: Annotated[Path, typer.Option(help="Folder for the plot and Triton's log.")] = Path("demo_output"),
    tritonserver: TritonPath = None,
) -> None:
    """Serve a checkpoint, score one video, plot, and stop everything."""
    import rfm_export

    try:
        from rfm.demo import score_video, served, show_metrics, stopped_by_signals
    except ImportError as error:
        _fail(f'the demo needs {error.name}: pip install "rfm-triton[demo,encoders,triton]"')
    console = Console()
    with stopped_by_signals(), TemporaryDirectory(prefix="rfm-demo-") as folder:
        try:
            if checkpoint is not None:
                repository = Path(folder) / "model_repository"
                encoders = {"image_encoder": image_encoder, "text_encoder": text_encoder}
                rfm_export.export(checkpoint, repository, _serve_config(None, **encoders, base_model=base_model))
            with served(repository, output / "tritonserver.log", tritonserver) as endpoints:
                score_video(endpoints, video, task, fps, output / "rewards.png", console)
                show_metrics(endpoints, console)
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
