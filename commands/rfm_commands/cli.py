# SPDX-License-Identifier: MIT
"""The ``rfm`` command. The only place where packages meet that otherwise do not know of each other."""

from __future__ import annotations

import importlib.metadata
import os
from collections.abc import Iterable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, NoReturn

import typer
from rich.console import Console

from rfm.checkpoint.content import CheckpointError
from rfm.checkpoint.provenance import table
from rfm.config import ExportConfig, ServeConfig
from rfm.launch.admin_key import AdminKeyError, take_key
from rfm.launch.endpoints import Endpoints
from rfm.launch.installation import ServerStartError, find_installation
from rfm.launch.process import TritonServer, short_spin
from rfm.launch.temporary import stopped_by_signals, temporary_server
from rfm.supervise.supervisor import Supervisor
from rfm_client import RewardError
from rfm_client.cli.options import Fps, finite
from rfm_client.contract.listening import from_here
from rfm_client.contract.names import frames_name
from rfm_client.contract.settings import ConfigError

try:
    import rfm_gateway  # noqa: F401  before the modules below, which import parts of it
except ModuleNotFoundError:
    raise SystemExit("rfm: expected the package rfm-gateway, got none: pip install ./client ./gateway .") from None
from rfm_commands.config import Config
from rfm_commands.label import label
from rfm_commands.models import AdminKeyFile
from rfm_commands.models import app as models_app
from rfm_commands.rollout import names_of
from rfm_gateway.command import gateway, gateway_command
from rfm_gateway.config import GatewayConfig
from rfm_gateway.options import Given, with_options

EXIT_FAILED = 1
ACCEPTED_WARNING = "a Triton with known remote vulnerabilities is accepted: use NVIDIA's container 26.07 or newer"
DEMO = Path("model_repository")
OF_A_DEMO = ("checkpoint", "image_encoder", "text_encoder", "base_model")

app = typer.Typer(
    name="rfm",
    help="Reward models for robot learning, served by Triton.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # whose tables cut the names of options off where a terminal has 80 columns
    context_settings={"help_option_names": ["-h", "--help"]},
)

ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="YAML file with sections export, serve, gateway; options win over it.")
]
Repository = Annotated[Path, typer.Option(help="Triton model repository.")]
TritonPath = Annotated[
    Path | None, typer.Option("--tritonserver", help="tritonserver program; else PATH, else the nvidia-pytriton wheel.")
]
Accepted = Annotated[
    bool,
    typer.Option(
        "--accept-known-vulnerabilities", help="Let other machines reach a Triton with known vulnerabilities."
    ),
]
MoreArguments = Annotated[
    list[str] | None,
    typer.Argument(metavar="-- --OPTION=VALUE...", help="More of tritonserver's options.", show_default=False),
]


def _print_version(is_wanted: bool) -> None:
    if is_wanted:
        typer.echo(f"rfm {importlib.metadata.version('rfm-triton')}")
        raise typer.Exit


@app.callback()
def rfm(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version and exit.")
    ] = False,
) -> None:
    """Reward models for robot learning, served by Triton."""


@app.command()
@with_options(ExportConfig, into="given")
def export(
    repository: Repository,
    config_file: ConfigFile = None,
    other_machine: Annotated[
        bool, typer.Option("--other-machine", help="It is served elsewhere: num_gpus may be more than there are here.")
    ] = False,
    device: Annotated[
        str | None,
        typer.Option(
            help="Where the scores of export and checkpoint are compared: cpu, cuda, cuda:1. Else the CPU, and for a "
            "vision-language checkpoint a GPU with room for it."
        ),
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Write nothing; compare with what would be written.")] = False,
    explain: Annotated[
        bool, typer.Option("--explain", help="Write nothing; print what decides each setting of the checkpoint.")
    ] = False,
    *,
    given: Given,
) -> None:
    """Write a checkpoint into a model repository, as a new version."""
    import rfm_export
    from rfm_commands.unused_settings import notes_at_export

    config = _config(config_file, export=given)
    _tell(config, notes_at_export(config))
    settings = config.export
    try:
        if check:
            differences = rfm_export.check(repository, settings)
            if differences:
                _fail("\n".join(differences))
            typer.echo(f"{repository}: every generated file is as an export would write it")
            return
        if settings.checkpoint is None:
            _fail("--checkpoint: expected a checkpoint, here or as export.checkpoint in --config, got none")
        if explain:
            typer.echo(table(rfm_export.explain(settings.checkpoint, settings, say=_say)))
            return
        version = rfm_export.export(
            settings.checkpoint,
            repository,
            settings,
            other_machine=other_machine,
            device=device,
            say=_say,
        )
    except (CheckpointError, rfm_export.ExportError, OSError) as error:
        _fail(str(error))
    typer.echo(f"{repository}: {settings.name} version {version}, scores equal to the checkpoint's")


@app.command()
@with_options(GatewayConfig, into="gateway_given", prefix="gateway_")
@with_options(ServeConfig, into="given")
def serve(
    repository: Repository,
    config_file: ConfigFile = None,
    admin_key_file: AdminKeyFile = None,
    accept_known_vulnerabilities: Accepted = False,
    tritonserver: TritonPath = None,
    more_arguments: MoreArguments = None,
    *,
    given: Given,
    gateway_given: Given,
) -> None:
    """Run tritonserver on a model repository until a signal stops it.

    Only requests with the admin key can change its models, logging and tracing. Without an admin key, nobody can.
    """
    from rfm_commands.unused_settings import notes_at_serve

    config = _config(config_file, serve=given, gateway=gateway_given)
    _tell(config, notes_at_serve(config, repository))
    if accept_known_vulnerabilities and not config.serve.is_loopback:
        typer.echo(f"rfm: warning: {config.serve.host} is no loopback address, and {ACCEPTED_WARNING}", err=True)
    try:
        server = TritonServer(
            repository,
            Endpoints.of(config.serve),
            find_installation(tritonserver),
            http_threads=config.serve.http_threads,
            admin_key=take_key(admin_key_file, os.environ),
            accepts_known_vulnerabilities=accept_known_vulnerabilities,
            more_arguments=more_arguments or (),
            hang_s=config.serve.hang_s,
        )
        status = _supervisor(server, config).run()
    except (AdminKeyError, ServerStartError, OSError) as error:
        _fail(str(error))
    raise typer.Exit(status)


def _supervisor(server: TritonServer, config: Config) -> Supervisor:
    """What runs the server, and a gateway if the configuration has one."""
    gateway = None if config.gateway.port is None else _beside(server, config)
    return Supervisor(
        server,
        gateway=None if gateway is None else gateway_command(gateway),
        status_port=config.serve.status_port,
        canary_s=config.serve.canary_s,
        hang_s=config.serve.hang_s,
        triton_silent_s=config.serve.triton_silent_s,
        say=_say,
    )


def _beside(server: TritonServer, config: Config) -> GatewayConfig:
    """The gateway before this server: what its section leaves open is the server's. It could start now."""
    gateway, endpoints = config.gateway, server.endpoints
    behind = replace(endpoints, host=from_here(endpoints.host))
    filled = replace(
        gateway,
        host=gateway.host or (endpoints.http_host if gateway.certificate is None else endpoints.host),
        triton=gateway.triton or (behind.grpc_url if behind.grpc_tls is None else behind.http_url),
        metrics_url=gateway.metrics_url or behind.metrics_url,
        model=gateway.model or config.export.name,
    )
    try:
        filled.check(os.environ)
    except (OSError, ValueError) as error:
        _fail(f"gateway: {error}")
    names = names_of(server.repository)
    if gateway.triton is None and names and filled.model not in names:
        _fail(f"gateway: model: expected one of {', '.join(names)}, got {filled.model}; --gateway-model names another")
    return filled


@app.command()
def tune(
    repository: Repository,
    output: Annotated[Path, typer.Option(help="YAML file for the best settings, for rfm export --config.")],
    config_file: ConfigFile = None,
    callers: Annotated[int, typer.Option(min=1, help="Callers at a time, each with one sample.")] = 32,
    frames: Annotated[bool, typer.Option("--frames", help="Send raw frames instead of embeddings.")] = False,
    seconds: Annotated[
        float, typer.Option(min=0.1, callback=finite, help="Seconds that each measurement takes.")
    ] = 3.0,
    rounds: Annotated[int, typer.Option(min=1, help="How often each setting is measured.")] = 3,
    tritonserver: TritonPath = None,
) -> None:
    """Find the settings that serve a repository best on this machine.

    It tries how many instances and threads, and what batches.
    """
    from rfm_commands.tune import Sweep, write_setting
    from rfm_commands.unused_settings import notes_at_tuning
    from rfm_export import ExportError

    config = _config(config_file)
    _tell(config, notes_at_tuning(config, repository))
    sweep = Sweep(repository, config.export.name, callers, seconds, rounds, frames, tritonserver, typer.echo)
    try:
        with stopped_by_signals():
            setting = sweep.best()
        write_setting(setting, output, config.file)
    except (ExportError, ServerStartError, RewardError, OSError) as error:
        _fail(str(error))
    typer.echo(f"{output}: {setting}")


app.command()(gateway)
app.command()(label)
app.add_typer(models_app, name="models")


@app.command()
@with_options(ExportConfig, into="given", only=OF_A_DEMO)
def demo(
    video: Annotated[Path, typer.Option(help="Video file to score.")],
    task: Annotated[str, typer.Option(help="What is to be done in the video, as a sentence.")],
    fps: Fps = 3.0,
    repository: Annotated[Path, typer.Option(help="Repository to serve, if no checkpoint is given.")] = DEMO,
    output: Annotated[Path, typer.Option(help="Folder for the plot and Triton's log.")] = Path("demo_output"),
    tritonserver: TritonPath = None,
    *,
    given: Given,
) -> None:
    """Serve a checkpoint, score one video, plot, and stop everything."""
    import rfm_export

    try:
        from rfm_client.data.video import read_video
        from rfm_commands.demo import score_video, show_metrics

        import_module("av")  # which reads the video
    except ImportError as error:
        _fail(f'the demo needs {error.name}: pip install ".[demo,encoders,triton]"')
    console, settings = Console(), _config(None, export=given).export
    with stopped_by_signals(), TemporaryDirectory(prefix="rfm-demo-") as folder:
        try:
            frames = read_video(video, fps)
            _make_folder(output)
            if settings.checkpoint is not None:
                repository = _exported_frames(settings.checkpoint, settings, Path(folder) / "model_repository")
            with temporary_server(repository, output / "tritonserver.log", tritonserver) as endpoints:
                score_video(endpoints, video, frames, task, output / "rewards.png", console)
                show_metrics(endpoints, console)
        except (CheckpointError, rfm_export.ExportError, ServerStartError, RewardError, OSError) as error:
            _fail(str(error))


def _make_folder(output: Path) -> None:
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        _fail(f"{output}: expected a folder that can be made, got: {error.strerror}; --output names another one")


def _exported_frames(checkpoint: str, settings: ExportConfig, repository: Path) -> Path:
    """The new repository of a checkpoint that scores frames."""
    import rfm_export

    rfm_export.export(checkpoint, repository, settings)
    if not (repository / frames_name(settings.name)).exists():
        _fail(f"{checkpoint}: expected one that scores frames, got none; name --image-encoder, --text-encoder")
    return repository


def _config(file: Path | None, **options: Given) -> Config:
    """The file's configuration with the options that were given on the command line, by section."""
    try:
        return (Config() if file is None else Config.from_yaml(file)).with_options(**options)
    except ConfigError as error:
        _fail(str(error))


def _tell(config: Config, notes: Iterable[str]) -> None:
    where = "" if config.file.path is None else f"{config.file.path}: "
    for note in notes:
        _say(f"{where}{note}")


def _say(line: str) -> None:
    typer.echo(f"rfm: {line}", err=True)


def _fail(message: str) -> NoReturn:
    _say(message)
    raise typer.Exit(EXIT_FAILED)


def main() -> None:
    """Entry point of the ``rfm`` console script."""
    os.environ.update(short_spin(os.environ))  # before PyTorch is imported
    app()
