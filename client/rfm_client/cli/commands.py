# SPDX-License-Identifier: MIT
"""The ``rfm-client`` commands. Optional libraries are imported when a command runs, so that ``--help`` is quick."""

from __future__ import annotations

import importlib.metadata
import logging
import time
from contextlib import nullcontext
from dataclasses import asdict
from importlib.metadata import entry_points
from typing import Annotated

import typer

from rfm_client.async_client import DEFAULT_IN_FLIGHT
from rfm_client.cli import comparing, documents, scoring
from rfm_client.cli.bench import Load, measure
from rfm_client.cli.command import (
    EXIT_CODES,
    MOST_COLUMNS,
    Command,
    Commands,
    ExitCode,
    exit_code_of,
    report,
    usage_errors,
    with_options,
    with_remedy,
)
from rfm_client.cli.options import (
    JsonOutput,
    OutputOptions,
    PrefixOptions,
    ScoredVideos,
    ServerOptions,
    StatusOptions,
    SyntheticSamples,
    VideoOptions,
    WaitOptions,
)
from rfm_client.cli.show import scores_table, status_tables, wrapped
from rfm_client.contract.errors import DeadlineExceededError, RewardError
from rfm_client.contract.results import FRAME_SCORES
from rfm_client.plot import plot_scores, save
from rfm_client.recording import Recording

app = typer.Typer(
    name="rfm-client",
    cls=Commands,
    help="Scores videos with a served reward model, and shows the state of its server.",
    epilog=f"To export and serve models, use rfm on the server: rfm --help\n\n{EXIT_CODES}",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # Rich's tables cut off option names in an 80-column terminal
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": MOST_COLUMNS},
)

MIN_COMPARED = 2

VIDEOS = "Videos, or .npy or .npz files."


def _print_version(is_wanted: bool) -> None:
    if is_wanted:
        typer.echo(f"rfm-client {importlib.metadata.version('rfm-client')}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version and exit.")
    ] = False,
) -> None:
    """Score videos with a served reward model, and show the state of its server."""
    logging.basicConfig(format="rfm-client: %(message)s", level=logging.WARNING)  # the client logs retries


@app.command(cls=Command, epilog=EXIT_CODES)
@with_options
def score(
    videos: Annotated[list[str], typer.Argument(metavar="VIDEO...", help=VIDEOS)],
    video: ScoredVideos,
    prefix: PrefixOptions,
    output: OutputOptions,
    server: ServerOptions,
) -> None:
    """Score each frame of one or more videos: progress and success. A failed video does not stop the others.

    Example: rfm-client score video.mp4 --task "put the block in the bowl"
    """
    output.begin(len(videos))
    video.begin(videos)
    shown: list[scoring.Scored] = []

    def tell(outcome: scoring.Outcome) -> None:
        if isinstance(outcome, scoring.Failed):
            report(f"{outcome.name}: {outcome.message}")
            return
        result = outcome.result
        _report_subsampled(outcome.name, len(result.progress), outcome.num_frames)
        for note in filter(None, (FRAME_SCORES[name].mark_note(each) for name, each in result.arrays.items())):
            report(f"note: {outcome.name}: {note}")
        if output.prints_tables:
            rows = (shown or [outcome])[0].table(videos)
            print(*rows.head * (not shown), rows.row(outcome.row), sep="\n", flush=True)
        shown.append(outcome)

    with nullcontext() if output.rrd is None else Recording(output.rrd) as recording, server.connected() as client:
        video.check_read(client)
        outcomes = scoring.SourceScorer(client, video, prefix, recording).score_all(videos, tell)
    infos = [outcome.info for outcome in shown]
    if output.prints_tables and shown:
        print("\n" + wrapped(scoring.rule(infos, prefix), "  ", "  "))
    scoring.report_warnings(infos)
    output.write_json(documents.score_document(server, video, prefix, outcomes))
    title = scoring.heading(video.task, infos, output.caption)
    if output.plot is not None and shown:
        names, times_s = scoring.unique_stems([each.name for each in shown]), [each.times_s for each in shown]
        results = [each.result for each in shown]
        save(plot_scores(results, names, title=title, times_s=times_s, size=output.size), output.plot)
    if output.strips is not None and shown:
        from rfm_client.cli.pictures import plot

        plot(output.strips, [outcome.panel for outcome in shown], title, size=output.size)
    raise typer.Exit(scoring.exit_code_of_outcomes(outcomes))


@app.command(cls=Command, epilog=EXIT_CODES)
@with_options
def compare(
    videos: Annotated[list[str], typer.Argument(metavar="VIDEO VIDEO...", help=VIDEOS)],
    video: VideoOptions,
    output: JsonOutput,
    server: ServerOptions,
) -> None:
    """Rank several videos by how well they do the task.

    Every two videos are compared in both orders. The rank follows the mean probability of winning against the others.
    A video has no rank ("?") if the orders disagree about one of its pairs. The table also shows progress at the end.

    Example: rfm-client compare a.mp4 b.mp4 --task "put the block in the bowl"
    """
    if len(videos) < MIN_COMPARED:
        raise typer.BadParameter(f"expected at least {MIN_COMPARED} videos, got {len(videos)}", param_hint="VIDEO")
    output.begin()
    video.begin(videos)
    with server.connected() as client:
        comparison = comparing.compare(client, videos, video)
    for source, scores in zip(comparison.sources, comparison.scores, strict=True):
        _report_subsampled(source.name, len(scores.progress), source.trajectory.num_frames)
    if output.prints_tables:
        typer.echo("\n".join(comparison.tables()))
    output.write_json(documents.comparison_document(server, video, comparison))


@app.command(cls=Command, epilog=EXIT_CODES)
@with_options
def status(
    output: JsonOutput,
    server: StatusOptions,
    metrics_url: Annotated[
        str | None,
        typer.Option(help="URL of the server's metrics. Default: port 8002 beside port 8000 or 8001."),
    ] = None,
) -> None:
    """Show the server's models, requests, batches, GPUs and memory.

    Triton counts since the model was loaded, warm-up included; a model counts callers' samples since Triton started.
    Failed requests got an error. Refused samples cannot be scored, and the caller has to mend them. queue ms is the
    mean wait of a request for its turn.

    Example: rfm-client status --url grpc://gpu-box:8001
    """
    from rfm_client.transport.status import ServerStatus

    if metrics_url is not None and len(server.urls) > 1:
        raise typer.BadParameter("--metrics-url needs a single --url")
    output.begin()
    with usage_errors("--url"):
        statuses = [
            ServerStatus.read(url, metrics_url=metrics_url, timeout_s=server.timeout_s, credentials=server.credentials)
            for url in server.urls
        ]
    if output.prints_tables:
        for each in statuses:
            typer.echo(status_tables(each))
            for model in each.checkpoints:
                typer.echo(_checkpoint(server, each.url, model))
    output.write_json(documents.status_document(statuses))


@app.command(cls=Command, epilog=EXIT_CODES)
@with_options
def wait(server: WaitOptions) -> None:
    """Wait until a server has the model ready, or --timeout passes. Fails at once if it denies access.

    Example: rfm-client wait --timeout 600
    """
    started_s = time.monotonic()
    try:
        with server.client() as client:
            server.check_access()
            client.wait_ready(server.timeout_s)
    except DeadlineExceededError as error:
        remedy = "start a server there (rfm serve), name a model that it serves (--model), or wait longer (--timeout)"
        raise DeadlineExceededError(f"{error}: {remedy}") from None
    typer.echo(f"ready after {time.monotonic() - started_s:.1f} s")


@app.command(cls=Command, epilog=EXIT_CODES)
@with_options
def sample(
    synthetic: SyntheticSamples,
    output: JsonOutput,
    server: ServerOptions,
) -> None:
    """Score synthetic samples, to check that the server answers. Their scores mean nothing.

    Example: rfm-client sample --num-samples 8
    """
    output.begin()
    with server.connected() as client:
        samples = synthetic.samples(client)
        outcomes = client.evaluate(samples, return_errors=True)
    failures = [outcome for outcome in outcomes if isinstance(outcome, RewardError)]
    told: dict[str, list[int]] = {}
    for index, outcome in enumerate(outcomes):
        if isinstance(outcome, RewardError):  # without the videos' remedy: --num-frames decides
            told.setdefault(str(with_remedy(outcome, "")), []).append(index)
    for message, (first, *others) in told.items():
        report(f"samples[{first}]{f' and {len(others)} more' if others else ''}: {message}")
    rows = [(f"{index}", outcome) for index, outcome in enumerate(outcomes) if not isinstance(outcome, RewardError)]
    if output.prints_tables and rows:
        of = "embeddings" if samples[0].trajectories[0].frames is None else "frames"
        typer.echo(scores_table(f"{synthetic.sample_type} of random {of}", rows))
    output.write_json(documents.samples_document(server, synthetic.sample_type, outcomes))
    raise typer.Exit(exit_code_of(failures, some_succeeded=len(failures) < len(outcomes)))


@app.command(cls=Command, epilog=EXIT_CODES)
@with_options
def bench(load: Load, output: JsonOutput, server: ServerOptions) -> None:
    """Tell whether the server holds a number of robots. Exit code 1: it does not.

    Each robot asks once per step, also while its earlier answers are late, about random embeddings or about an episode
    to which it adds a random frame. Time counts from when the step is due. The load is held if 99 % of the steps are
    answered before the next one is due, and none fails.

    Example: rfm-client bench --robots 8 --hz 10
    """
    output.begin()
    with server.connected(max_in_flight=max(DEFAULT_IN_FLIGHT, load.robots)) as client:
        measured = measure(client, load)
    if output.prints_tables:
        typer.echo(measured.report(load))
    output.write_json({**server.origin, **asdict(load), **asdict(measured), "held": measured.is_held})
    raise typer.Exit(ExitCode.OK if measured.is_held else ExitCode.FAILED)


def _checkpoint(server: StatusOptions, url: str, model: str) -> str:
    """Return a line for the user: which checkpoint the model is."""
    try:
        with server.client(url, model=model, retry=False) as client:
            return wrapped(f"checkpoint of {model}: {scoring.checkpoint_name(client.model_info(frames=True))}")
    except RewardError as error:
        return wrapped(f"checkpoint of {model}: {error}")


def _report_subsampled(name: str, num_scored: int, num_frames: int) -> None:
    if num_scored < num_frames:
        report(f"note: {name}: {num_scored} of {num_frames} frames were scored, evenly spaced")


def _add_applications() -> None:
    """Add the commands of installed applications."""
    for found in sorted(entry_points(group="rfm_client.commands"), key=lambda each: each.name):
        try:
            app.command(found.name, cls=Command, epilog=EXIT_CODES)(found.load())
        except ImportError as error:
            Commands.missing[found.name] = f"{error}: {Commands.missing.get(found.name, found.value)}"


_add_applications()
