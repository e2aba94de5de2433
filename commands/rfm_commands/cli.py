# SPDX-License-Identifier: MIT
"""The ``rfm`` command. The only place where packages meet that otherwise do not know of each other."""

from __future__ import annotations

import os
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console

from rfm.checkpoint.content import CheckpointError
from rfm.config import ConfigError, ServeConfig
from rfm.supervise.admin_key import AdminKeyError, take_key
from rfm.supervise.installation import ServerStartError, find_installation
from rfm.supervise.process import Endpoints, TritonServer
from rfm.supervise.supervisor import Supervisor
from rfm.supervise.temporary import served, stopped_by_signals
from rfm_client import RewardError
from rfm_client.contract.names import frames_name
from rfm_commands.models import AdminKeyFile
from rfm_commands.models import app as models_app
from rfm_gateway.command import gateway, gateway_command
from rfm_gateway.limits import Limits, with_limits

EXIT_FAILED = 1
BATCH_SIZE_NOTE = "batch_size has no effect, as in the FastAPI server; max_batch_size bounds a batch"
ACCEPTED_WARNING = "a Triton with known remote vulnerabilities is accepted: use NVIDIA's container 26.07 or newer"

app = typer.Typer(
    name="rfm",
    help="Reward models for robot learning, served by Triton.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Config = Annotated[Path | None, typer.Option(help="YAML file of a ServeConfig; options given here win over it.")]
BaseModel = Annotated[
    str | None,
    typer.Option(help="Folder or id of a vision-language checkpoint's base model; else the one that it names."),
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
    resize_images: Annotated[
        bool | None,
        typer.Option(
            help="Whether a multi-image checkpoint was trained at its run's data.resized_height and _width.",
            show_default=False,
        ),
    ] = None,
    other_machine: Annotated[
        bool, typer.Option("--other-machine", help="It is served elsewhere: num_gpus may be more than there are here.")
    ] = False,
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
        resize_images=resize_images,
    )
    try:
        if check:
            differences = rfm_export.check(repository, serve)
            if differences:
                _fail("\n".join(differences))
            typer.echo(f"{repository}: every generated file is as an export would write it")
            return
        if serve.model_path is None:
            _fail("--checkpoint: expected a checkpoint, here or as model_path in --config, got none")
        version = rfm_export.export(serve.model_path, repository, serve, other_machine=other_machine)
    except (CheckpointError, rfm_export.ExportError, OSError) as error:
        _fail(str(error))
    typer.echo(f"{repository}: {serve.name} version {version}, scores equal to the checkpoint's")


@app.command()
@with_limits("gateway_")
def serve(
    repository: Repository,
    config: Config = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on (127.0.0.1).")] = None,
    http_port: Annotated[int | None, typer.Option(help="HTTP port (8000).")] = None,
    grpc_port: Annotated[int | None, typer.Option(help="gRPC port (8001).")] = None,
    metrics_port: Annotated[int | None, typer.Option(help="Port of the Prometheus metrics (8002).")] = None,
    gateway_port: Annotated[
        int | None,
        typer.Option(help="Serve the FastAPI evaluation server's endpoints, too, on this port (see rfm gateway)."),
    ] = None,
    status_port: Annotated[
        int | None, typer.Option(help="Port of rfm serve's own state: /live, /ready and /metrics.")
    ] = None,
    triton_silent_s: Annotated[
        int | None, typer.Option(help="Seconds that Triton may give no answer before it is killed and restarted (10).")
    ] = None,
    admin_key_file: AdminKeyFile = None,
    grpc_certificate: Annotated[
        str | None, typer.Option(help="Serve gRPC with TLS, by this certificate (PEM); HTTP then only on 127.0.0.1.")
    ] = None,
    grpc_key: Annotated[str | None, typer.Option(help="The certificate's key (PEM).")] = None,
    grpc_client_ca: Annotated[
        str | None, typer.Option(help="Authorities (PEM) of gRPC's clients, which then need a certificate.")
    ] = None,
    accept_known_vulnerabilities: Annotated[
        bool,
        typer.Option(
            "--accept-known-vulnerabilities", help="Let other machines reach a Triton with known vulnerabilities."
        ),
    ] = False,
    tritonserver: TritonPath = None,
    more_arguments: Annotated[
        list[str] | None,
        typer.Argument(metavar="-- --OPTION=VALUE...", help="More of tritonserver's options.", show_default=False),
    ] = None,
    *,
    limits: Limits,
) -> None:
    """Run tritonserver on a model repository until a signal stops it.

    Only requests with the admin key can change its models, logging and tracing. Without an admin key, nobody can.
    """
    settings = _serve_config(
        config,
        server_url=host,
        server_port=http_port,
        grpc_port=grpc_port,
        metrics_port=metrics_port,
        gateway_port=gateway_port,
        status_port=status_port,
        triton_silent_s=triton_silent_s,
        grpc_certificate=grpc_certificate,
        grpc_key=grpc_key,
        grpc_client_ca=grpc_client_ca,
    )
    try:
        if accept_known_vulnerabilities and not settings.is_loopback:
            typer.echo(f"rfm: warning: {settings.host} is no loopback address, and {ACCEPTED_WARNING}", err=True)
        installation = find_installation(tritonserver)
        endpoints = Endpoints.of(settings)
        companion = None
        if settings.gateway_port is not None:
            companion = gateway_command(
                endpoints.grpc_url if endpoints.grpc_tls is None else endpoints.http_url,  # it needs no certificate
                endpoints.metrics_url,
                settings.name,
                endpoints.http_host,  # it has no TLS either
                settings.gateway_port,
                limits=limits,
            )
        server = TritonServer(
            repository,
            endpoints,
            installation,
            http_threads=settings.max_workers,
            admin_key=take_key(admin_key_file, os.environ),
            accepts_known_vulnerabilities=accept_known_vulnerabilities,
            more_arguments=more_arguments or (),
            ends_with_parent=True,
        )
        supervisor = Supervisor(
            server,
            gateway=companion,
            status_port=settings.status_port,
            canary_s=settings.canary_s,
            hang_s=settings.hang_s,
            triton_silent_s=settings.triton_silent_s,
            say=lambda line: typer.echo(f"rfm: {line}", err=True),
        )
        status = supervisor.run()
    except (AdminKeyError, ServerStartError) as error:
        _fail(str(error))
    raise typer.Exit(status)


@app.command()
def tune(
    repository: Repository,
    output: Annotated[Path, typer.Option(help="YAML file for the best settings, for rfm export --config.")],
    config: Config = None,
    callers: Annotated[int, typer.Option(min=1, help="Callers at a time, each with one sample.")] = 32,
    frames: Annotated[bool, typer.Option("--frames", help="Send raw frames instead of embeddings.")] = False,
    seconds: Annotated[float, typer.Option(min=0.1, help="Seconds that each measurement takes.")] = 3.0,
    rounds: Annotated[int, typer.Option(min=1, help="How often each setting is measured.")] = 3,
    tritonserver: TritonPath = None,
) -> None:
    """Try how many instances and threads, and what batches, serve a repository best on this machine."""
    from rfm_commands.tune import Sweep, write_setting
    from rfm_export import ExportError

    name = _serve_config(config).name
    sweep = Sweep(repository, name, callers, seconds, rounds, frames, tritonserver, typer.echo)
    try:
        with stopped_by_signals():
            setting = sweep.best()
        write_setting(setting, output, config)
    except (ExportError, ServerStartError, RewardError, OSError) as error:
        _fail(str(error))
    typer.echo(f"{output}: {setting}")


app.command()(gateway)
app.add_typer(models_app, name="models")


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
        from rfm_commands.demo import score_video, show_metrics

        import_module("av")  # which reads the video, once all is served
    except ImportError as error:
        _fail(f'the demo needs {error.name}: pip install ".[demo,encoders,triton]"')
    console = Console()
    with stopped_by_signals(), TemporaryDirectory(prefix="rfm-demo-") as folder:
        try:
            if checkpoint is not None:
                repository = Path(folder) / "model_repository"
                encoders = {"image_encoder": image_encoder, "text_encoder": text_encoder}
                serve = _serve_config(None, **encoders, base_model=base_model)
                rfm_export.export(checkpoint, repository, serve)
                if not (repository / frames_name(serve.name)).exists():
                    _fail(
                        f"{checkpoint}: expected one that scores frames, got none; name --image-encoder, --text-encoder"
                    )
            with served(repository, output / "tritonserver.log", tritonserver) as endpoints:
                score_video(endpoints, video, task, fps, output / "rewards.png", console)
                show_metrics(endpoints, console)
        except (CheckpointError, rfm_export.ExportError, ServerStartError, RewardError) as error:
            _fail(str(error))


def _serve_config(file: Path | None, **options: Any) -> ServeConfig:
    """The file's configuration with the options that were given on the command line."""
    try:
        config = ServeConfig() if file is None else ServeConfig.from_yaml(file)
        if config.batch_size is not None:
            typer.echo(f"rfm: {file}: {BATCH_SIZE_NOTE}", err=True)
        return replace(config, **{key: value for key, value in options.items() if value is not None})
    except ConfigError as error:
        _fail(str(error))


def _fail(message: str) -> NoReturn:
    typer.echo(f"rfm: {message}", err=True)
    raise typer.Exit(EXIT_FAILED)


def main() -> None:
    """Entry point of the ``rfm`` console script."""
    app()
