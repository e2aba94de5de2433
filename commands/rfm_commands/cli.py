# SPDX-License-Identifier: MIT
"""The ``rfm`` command. Only this package joins packages that do not import each other."""

from __future__ import annotations

import importlib.metadata
import logging
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from rfm.config import CheckpointConfig, ExportConfig, ServeConfig
from rfm.serve.access import NO_KEY, Endpoints, callers_restrictions, new_key, read_key, take_key
from rfm.serve.installation import ServerStartError, find_installation, has_gpu, without_gpus
from rfm.serve.repository import models_in, no_models
from rfm.serve.supervisor import CrashLoopError, GatewayProcess, Supervisor
from rfm.serve.triton_server import TritonServer, short_spin
from rfm_client.cli.command import MOST_COLUMNS, OptionValues, with_options
from rfm_client.contract.addresses import from_here
from rfm_client.contract.checks import require
from rfm_client.contract.process import raise_limit, write_log
from rfm_client.contract.settings import ConfigError

try:
    from rfm_gateway import (
        GatewayConfig,
        check_gateway,
        gateway,
        gateway_command,
    )  # before the modules below, which import it
except ModuleNotFoundError:
    raise SystemExit("rfm: expected the package rfm-gateway, got none: pip install ./client ./apps/gateway .") from None
from rfm_commands.cached_export import exported, is_checkpoint
from rfm_commands.command import AdminKeyFile, RfmCommand, RfmCommands, TritonPath, fail, say, timed_steps
from rfm_commands.config import Config, GatewayBeside, named_as_typed
from rfm_commands.models import app as models_app
from rfm_commands.rollout import names_of
from rfm_commands.serve_screen import ServeScreen, doors, log_file, opened
from rfm_commands.try_video import try_video

ACCEPTED_WARNING = "a Triton with known remote vulnerabilities is accepted: use NVIDIA's container 26.07 or newer"

logger = logging.getLogger("rfm.serve")

app = typer.Typer(
    name="rfm",
    cls=RfmCommands,
    help="Reward models for robot learning, served by Triton.",
    epilog="rfm runs on the server. On every other machine use rfm-client, which scores videos: rfm-client --help",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # Rich's tables cut off option names in a terminal with 80 columns
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": MOST_COLUMNS},
)

ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="YAML file with sections export, serve, gateway; options win over it.")
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


@app.command(cls=RfmCommand)
@with_options
def export(
    given: OptionValues[ExportConfig],
    repository: Annotated[Path, typer.Option(help="Triton model repository.")],
    source: Annotated[
        str | None, typer.Argument(metavar="CHECKPOINT", help="The same as --checkpoint.", show_default=False)
    ] = None,
    config_file: ConfigFile = None,
    other_machine: Annotated[
        bool, typer.Option("--other-machine", help="Export for another machine, which may have more GPUs.")
    ] = False,
    device: Annotated[
        str | None,
        typer.Option(
            help="Device that compares the scores of export and checkpoint: cpu, cuda, cuda:1. Default: the CPU; for a "
            "vision-language checkpoint a GPU with enough memory."
        ),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Write nothing; compare the repository with what would be written.")
    ] = False,
) -> None:
    """Write a checkpoint into a model repository, as a new version.

    Example: rfm export org/name --repository my_models
    """
    import rfm_export

    if source is not None:
        if "checkpoint" in given:
            raise typer.BadParameter("give CHECKPOINT or --checkpoint, not both")
        given["checkpoint"] = source
    settings = _config(config_file, export=given).export
    if check:
        differences = rfm_export.check(repository, settings)
        for difference in differences:
            say(difference)
        if differences and config_file is None:
            say("if the export had settings of a file, name the file with --config")
        if differences:
            raise typer.Exit(1)
        typer.echo(f"{repository}: every generated file is as an export would write it")
        return
    if settings.checkpoint is None:
        fail("CHECKPOINT: expected a checkpoint, here or as export.checkpoint in --config, got none")
    with timed_steps() as begin:
        version = rfm_export.export(
            settings.checkpoint, repository, settings, other_machine=other_machine, device=device, say=say, begin=begin
        )
    whose = "the checkpoint's" if settings.weights is None else f"those of the checkpoint in {settings.weights}"
    typer.echo(f"{repository}: {settings.name} version {version}, scores equal to {whose}")


class ServeCommand(RfmCommand):
    """``rfm serve``: an error about an unknown option says where tritonserver's options belong."""

    unknown_option = (
        "put options of tritonserver after --, as in rfm serve FOLDER -- {option}=VALUE, and more of an export's "
        "settings into --config"
    )


@app.command(cls=ServeCommand)
@with_options
def serve(
    given: OptionValues[ServeConfig],
    gateway_given: OptionValues[GatewayBeside],
    checkpoint_given: OptionValues[CheckpointConfig],
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="FOLDER|CHECKPOINT [-- --OPTION=VALUE...]",
            help="Triton model repository, or a checkpoint, and more of tritonserver's options.",
            show_default=False,
        ),
    ] = None,
    repository: Annotated[Path | None, typer.Option(help="The repository; the same as FOLDER.")] = None,
    config_file: ConfigFile = None,
    admin_key_file: AdminKeyFile = None,
    accept_known_vulnerabilities: Annotated[
        bool,
        typer.Option(
            "--accept-known-vulnerabilities", help="Let other machines reach a Triton with known vulnerabilities."
        ),
    ] = False,
    tritonserver: TritonPath = None,
    triton_log: Annotated[
        Path | None,
        typer.Option(
            help="File for the lines of Triton and the models. Default: standard error; in a terminal, "
            "~/.local/state/rfm/triton-PORT.log."
        ),
    ] = None,
) -> None:
    """Run tritonserver on a model repository until a signal stops it.

    A checkpoint, org/name or a folder, is exported into ~/.cache/rfm first, unless it is there. With --gateway-port it
    also runs a gateway, and watches both.

    Only requests with the admin key can change its models, logging and tracing; without an admin key, no request can.

    Example: rfm serve org/name --gateway-port 8100
    """
    raise_limit()  # Triton and the gateway inherit it
    word, more_arguments = _word_and_arguments(words or ())
    if not has_gpu():
        more_arguments = [*without_gpus(more_arguments), *more_arguments]
    config = _config(config_file, serve=given, gateway=gateway_given, export=checkpoint_given)
    key_file = config.serve.api_key_file
    api_key = None if key_file is None else read_key(key_file, "--api-key-file")
    more_arguments = [*callers_restrictions(api_key, more_arguments), *more_arguments]
    if gateway_given and config.gateway.port is None:
        option = GatewayBeside.settings()[next(iter(gateway_given))].option
        raise typer.BadParameter(f"{option} needs --gateway-port, which starts the gateway")
    write_log("rfm-serve", os.environ)
    if accept_known_vulnerabilities and not config.serve.is_loopback:
        logger.warning("%s is no loopback address, and %s", config.serve.host, ACCEPTED_WARNING)
    admin_key = take_key(admin_key_file, os.environ) or new_key()
    endpoints = Endpoints.of(config.serve, config.gateway.port)
    installation = find_installation(tritonserver)
    folder = _served(word, repository, config.export, checkpoint_given)
    log = log_file(triton_log, endpoints.http_port, os.environ)
    with opened(log) as lines:
        server = TritonServer(
            folder,
            endpoints,
            installation,
            http_threads=config.serve.http_threads,
            log=lines,
            admin_key=admin_key,
            api_key=api_key,
            accepts_known_vulnerabilities=accept_known_vulnerabilities,
            more_arguments=more_arguments,
            hang_s=config.serve.hang_s,
        )
        beside = None if config.gateway.port is None else _beside(server, config, gateway_given)
        of_callers = api_key, None if beside is None else beside.api_key(os.environ)
        require("admin key", admin_key not in of_callers, "another than the callers' key", "the same: make its own")
        found = doors(endpoints, more_arguments, config.serve.status_port, beside, os.environ)
        asked = config.serve
        is_open = asked.grpc_certificate is not None and found["gRPC"][1] == NO_KEY
        if is_open and not (asked.grpc_any_client or asked.is_loopback):
            ways = f"client certificates (--grpc-client-ca) or a key (--api-key-file) at {asked.host}"
            expected = f"{ways}, since TLS alone asks for nothing"
            fail(f"--grpc-certificate: expected {expected}, got none; --grpc-any-client serves everyone")
        screen = None
        if log is not None and sys.stderr.isatty():
            screen = ServeScreen(folder, endpoints, found, log, key_file)
        supervisor = Supervisor(
            server,
            gateway=None if beside is None else _gateway_process(beside, config),
            status_port=config.serve.status_port,
            probe_s=config.serve.probe_s,
            triton_silent_s=config.serve.triton_silent_s,
            tell_ready=None if screen is None else screen.show_ready,
        )
        if screen is not None:
            screen.show_start()
        else:
            kinds = dict.fromkeys(needs for _, needs in found.values())
            ports = {kind: ", ".join(name for name, (_, needs) in found.items() if needs == kind) for kind in kinds}
            if not has_gpu():
                logger.info("no GPU: Triton's lines about CUDA, streams and pinned memory are no faults")
            logger.info("%s", "; ".join(f"{kind}: {names}" for kind, names in ports.items()))
        _run(supervisor, log)


app.command(cls=RfmCommand)(gateway)
try:
    from rfm_commands.label import label

    app.command(cls=RfmCommand)(label)
except ModuleNotFoundError as error:
    RfmCommands.missing["label"] = f"{error}: {RfmCommands.missing['label']}"
app.command("try", cls=RfmCommand)(try_video)
app.add_typer(models_app, name="models")


def _word_and_arguments(words: Sequence[str]) -> tuple[str | None, Sequence[str]]:
    """Return the word before ``--``, and tritonserver's arguments: typer passes words after ``--`` as words, too."""
    word = words[0] if words and not words[0].startswith("-") else None
    arguments = words if word is None else words[1:]
    if wrong := [word for word in arguments if not word.startswith("-")]:
        raise typer.BadParameter(f"expected one FOLDER, and after it -- --OPTION=VALUE, got {' '.join(wrong)}")
    return word, arguments


def _served(
    word: str | None, repository: Path | None, settings: ExportConfig, given: OptionValues[CheckpointConfig]
) -> Path:
    """Return the repository to serve: the named one, or a checkpoint's export in the cache.

    word: FOLDER or CHECKPOINT
    given: options for an export, of which ``settings`` has all values
    """
    if word is not None and repository is not None:
        raise typer.BadParameter("give FOLDER or --repository, not both")
    checkpoint = given.get("checkpoint")
    if word is not None and is_checkpoint(word):
        if checkpoint is not None:
            raise typer.BadParameter("give CHECKPOINT or --checkpoint, not both")
        checkpoint = word
    elif (folder := repository if word is None else Path(word)) is not None:
        if given and not models_in(folder):
            fail(no_models(folder))
        if given:
            option = CheckpointConfig.settings()[next(iter(given))].option
            raise typer.BadParameter(f"{option} decides an export, but {folder} names a repository")
        return folder
    if (checkpoint := checkpoint or settings.checkpoint) is None:
        raise typer.BadParameter("give FOLDER, CHECKPOINT or --repository")
    return exported(replace(settings, checkpoint=checkpoint))


def _run(supervisor: Supervisor, log: Path | None) -> None:
    size = 0 if log is None else log.stat().st_size
    try:
        supervisor.run()
    except ServerStartError as error:
        if log is not None and log.stat().st_size > size:
            say(f"the lines of Triton and the models are in {log}")
        if not isinstance(error, CrashLoopError):
            raise
        logger.error("%s", error)  # in the same form as the faults logged before
        raise typer.Exit(1) from None


def _gateway_process(gateway: GatewayConfig, config: Config) -> GatewayProcess:
    assert gateway.host is not None and gateway.port is not None  # completed
    address = from_here(gateway.host), gateway.port
    return GatewayProcess(gateway_command(gateway), address, config.serve.triton_silent_s)


def _beside(server: TritonServer, config: Config, given: OptionValues[GatewayBeside]) -> GatewayConfig:
    """Return the gateway's configuration, completed from the server's and checked: the gateway could start now."""
    gateway, endpoints = config.gateway, server.endpoints
    behind = replace(endpoints, host=from_here(endpoints.host))
    filled = replace(
        gateway,
        host=gateway.host or (endpoints.http_host if gateway.certificate is None else endpoints.host),
        triton=gateway.triton or (behind.grpc_url if behind.grpc_tls is None else behind.http_url),
        metrics_url=gateway.metrics_url or behind.metrics_url,
        model=gateway.model or config.export.name,
        triton_api_key_file=gateway.triton_api_key_file or (None if gateway.triton else config.serve.api_key_file),
    )
    try:
        if filled.api_key(os.environ) is None:
            filled = replace(filled, api_key_file=config.serve.api_key_file)
        check_gateway(filled, os.environ)
    except ConfigError as error:
        fail(str(error.named(partial(named_as_typed, "gateway", given)) if error.where in filled.settings() else error))
    except (OSError, ValueError) as error:
        fail(f"gateway: {error}")
    names = names_of(server.repository)
    if gateway.triton is None and names and filled.model not in names:
        fail(f"gateway: model: expected one of {', '.join(names)}, got {filled.model}; --gateway-model names another")
    return filled


def _config(file: Path | None, **options: OptionValues[Any]) -> Config:
    """Return the file's configuration with each section's given options."""
    return (Config() if file is None else Config.from_yaml(file)).with_options(**options)


def main() -> None:
    """Run ``rfm`` with the words of the command line."""
    os.environ.update(short_spin(os.environ))  # before PyTorch is imported
    app()
