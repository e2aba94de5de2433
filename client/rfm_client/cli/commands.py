# SPDX-License-Identifier: MIT
"""The commands. What a library brings along is imported when a command runs, so that ``--help`` is quick."""

from __future__ import annotations

import importlib.metadata
import logging
import shlex
from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated

import typer

from rfm_client.async_client import DEFAULT_TIMEOUT_S
from rfm_client.cli import comparing, options, outputs, scoring, toy
from rfm_client.cli.label import label
from rfm_client.cli.options import EXIT_CODES, STANDARD_OUTPUT, OneLineCommand, Server
from rfm_client.cli.scoring import Failed, Outcome, Question, Scored
from rfm_client.cli.show import MAX_PANELS, print_tables
from rfm_client.contract.addresses import split_url
from rfm_client.contract.errors import RewardError
from rfm_client.contract.names import DEFAULT_MODEL, frames_name
from rfm_client.contract.samples import MAX_FRAME_STEPS, MIN_FRAME_STEPS

MIN_COMPARED = 2

app = typer.Typer(
    name="rfm-client",
    help="Scores videos with a served reward model, and shows the state of its server.",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # whose tables cut the names of options off where a terminal has 80 columns
    context_settings={"help_option_names": ["-h", "--help"]},
)

Kind = Annotated[toy.SampleKind, typer.Option("--sample-type", help="What a sample asks.")]
NumSamples = Annotated[int, typer.Option(min=1, max=10_000, help="Samples to make up.")]
NumFrames = Annotated[
    str, typer.Option(metavar="N|N,M,...|N-M", help="Frames of a trajectory: one length, several or a range, in turn.")
]
UseFrames = Annotated[bool, typer.Option("--use-frames", help="Random frames, also where embeddings would do.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the random numbers.")]


def _print_version(is_wanted: bool) -> None:
    if is_wanted:
        typer.echo(f"rfm-client {importlib.metadata.version('rfm-client')}")
        raise typer.Exit


@app.callback()
def main(
    context: typer.Context,
    ca_file: options.CaFile = None,
    client_certificate: options.ClientCertificate = None,
    client_key: options.ClientKey = None,
    api_key_file: options.ApiKeyFile = None,
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version and exit.")
    ] = False,
) -> None:
    """Scores videos with a served reward model, and shows the state of its server."""
    logging.basicConfig(format="rfm-client: %(message)s", level=logging.WARNING)  # the client logs retries
    context.obj = options.read_access(ca_file, client_certificate, client_key, api_key_file)


@app.command(cls=OneLineCommand, epilog=EXIT_CODES)
def score(
    context: typer.Context,
    videos: Annotated[
        list[str], typer.Argument(metavar="VIDEO...", help="Videos, .npy or .npz files, or URLs of videos.")
    ],
    urls: options.Urls,
    task: options.Task = "",
    model: options.Model = DEFAULT_MODEL,
    fps: options.Fps = 3.0,
    max_frames: options.MaxFrames = None,
    subsample: options.Subsample = True,
    frame_steps: Annotated[
        int,
        typer.Option(
            min=0,
            max=MAX_FRAME_STEPS,
            help="Dense mode: score frame t on its prefix 0..t alone, sampled to so many frames.",
        ),
    ] = 0,
    sampling: options.SamplingRule = None,
    frames: options.SampledFrames = None,
    resize: options.Resize = False,
    orient: options.Orient = "none",
    plot: options.Plot = None,
    rrd: options.Recorded = None,
    json: options.Json = None,
    npy: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE|FOLDER",
            help="Write float32 [T, 2], progress and success: to a .npy file (one video), or one a video to a folder.",
        ),
    ] = None,
    timeout: options.TimeoutS = DEFAULT_TIMEOUT_S,
) -> None:
    """Progress and success at each frame of one or many videos. One that fails does not stop the others."""
    from rfm_client.cli import show

    options.check_outputs(json, plot, rrd)
    outputs.check_arrays(npy, videos)
    _check_panels(plot, videos)
    if 0 < frame_steps < MIN_FRAME_STEPS:
        expected = f"expected 0 or at least {MIN_FRAME_STEPS}, got {frame_steps}"
        raise typer.BadParameter(expected, param_hint="--frame-steps")
    options.check_sampling(sampling, frames, others={"--frame-steps": frame_steps, "--max-frames": max_frames})
    server = Server(urls, model, timeout, context.obj)
    question = Question(task, fps, max_frames, frame_steps, subsample, resize, sampling, frames, orient)
    rows = None if json == STANDARD_OUTPUT else outputs.Rows(videos)
    arrays = outputs.Arrays(npy, videos)

    def tell(number: int, outcome: Outcome) -> None:
        if isinstance(outcome, Failed):
            options.report(f"{outcome.name}: {outcome.message}")
            return
        _report_subsampled(outcome.name, len(outcome.result.progress), outcome.num_frames)
        arrays.write(number, outcome)
        if rows is not None:
            rows.write(outcome.row())

    with outputs.recorder(rrd, videos) as record:
        outcomes = scoring.score_all(server, videos, question, tell, record)
    scored = [outcome for outcome in outcomes if isinstance(outcome, Scored)]
    if rows is not None and scored:
        rows.end(question.rule)
    if json is not None:
        outputs.write_json(json, outputs.score_document(server, question, outcomes))
    if plot is not None and scored:
        show.plot(plot, [outcome.panel for outcome in scored])
    raise typer.Exit(scoring.exit_code_of(outcomes))


@app.command(cls=OneLineCommand, epilog=EXIT_CODES)
def compare(
    context: typer.Context,
    videos: Annotated[
        list[str], typer.Argument(metavar="VIDEO VIDEO...", help="Videos, .npy or .npz files, or URLs of videos.")
    ],
    urls: options.Urls,
    task: options.Task = "",
    model: options.Model = DEFAULT_MODEL,
    fps: options.Fps = 3.0,
    max_frames: options.MaxFrames = None,
    subsample: options.Subsample = True,
    resize: options.Resize = False,
    orient: options.Orient = "none",
    plot: options.Plot = None,
    json: options.Json = None,
    timeout: options.TimeoutS = DEFAULT_TIMEOUT_S,
) -> None:
    """Which of several videos does the task best.

    Every two are compared in both orders. They are ranked by the mean probability of winning against the others.
    A video is not ranked ("?") if the orders disagree about it and another one. The progress in each is shown, too.
    """
    from rfm_client.cli import show

    options.check_outputs(json, plot)
    if len(videos) < MIN_COMPARED:
        raise typer.BadParameter(f"expected at least {MIN_COMPARED} videos, got {len(videos)}", param_hint="VIDEO")
    _check_panels(plot, videos)
    server = Server(urls, model, timeout, context.obj)
    question = Question(task, fps, max_frames, subsample=subsample, resize=resize, orient=orient)
    comparison = comparing.compare(server, videos, question)
    for source, scores in zip(comparison.sources, comparison.scores, strict=True):
        _report_subsampled(source.name, len(scores.progress), source.trajectory.num_frames)
    if json != STANDARD_OUTPUT:
        print_tables(*comparison.tables())
    if json is not None:
        outputs.write_json(json, outputs.comparison_document(server, question, comparison))
    if plot is not None:
        show.plot(plot, comparison.panels(), title=f'"{task}"' if task else None)


@app.command(cls=OneLineCommand, epilog=EXIT_CODES)
def status(
    context: typer.Context,
    urls: options.Urls,
    metrics_url: Annotated[
        str | None, typer.Option(help="Where the server shows its metrics (http://<its host>:8002/metrics).")
    ] = None,
    json: options.Json = None,
    timeout: options.TimeoutS = 10.0,
) -> None:
    """The server's models, requests, batches, GPUs and memory."""
    from rfm_client.cli.show import status_tables
    from rfm_client.transport.status import read_status

    options.check_outputs(json, None)
    if metrics_url is not None and len(urls) > 1:
        raise typer.BadParameter("expected one --url with it, got several", param_hint="--metrics-url")
    with options.usage_errors("--url"):
        statuses = [read_status(url, metrics_url=metrics_url, timeout_s=timeout, access=context.obj) for url in urls]
    if json != STANDARD_OUTPUT:
        print_tables(*(table for status in statuses for table in status_tables(status)))
    if json is not None:
        outputs.write_json(json, outputs.status_document(statuses))


@app.command(cls=OneLineCommand, epilog=EXIT_CODES)
def wait(
    context: typer.Context,
    urls: options.Urls,
    model: options.Model = DEFAULT_MODEL,
    timeout: Annotated[
        float, typer.Option(min=options.MIN_TIMEOUT_S, callback=options.finite, help="Seconds to wait at most.")
    ] = 120.0,
) -> None:
    """Return as soon as the model is ready. Of several servers, one is enough."""
    from rfm_client.client import RewardClient

    with options.usage_errors("--url"):
        client = RewardClient(urls, model=model, **context.obj.options)
    with client:
        client.wait_ready(timeout)


@app.command(cls=OneLineCommand, epilog=EXIT_CODES)
def sample(
    context: typer.Context,
    urls: options.Urls,
    kind: Kind = toy.SampleKind.progress,
    model: options.Model = DEFAULT_MODEL,
    num_samples: NumSamples = 4,
    num_frames: NumFrames = "8",
    use_frames: UseFrames = False,
    seed: Seed = 0,
    json: options.Json = None,
    timeout: options.TimeoutS = DEFAULT_TIMEOUT_S,
) -> None:
    """Score made-up samples, to see that the server answers. Their scores mean nothing."""
    from rfm_client.cli.show import scores_table

    options.check_outputs(json, None)
    server = Server(urls, model, timeout, context.obj)
    made_up = _toy(kind, num_samples, num_frames, use_frames, seed)
    with server.connected() as client:
        samples = made_up.samples(client)
        outcomes = client.evaluate(samples, return_errors=True)
    failures = [outcome for outcome in outcomes if isinstance(outcome, RewardError)]
    for index, outcome in enumerate(outcomes):
        if isinstance(outcome, RewardError):
            options.report(f"samples[{index}]: {outcome}")
    rows = [(f"{index}", outcome) for index, outcome in enumerate(outcomes) if not isinstance(outcome, RewardError)]
    if json != STANDARD_OUTPUT and rows:
        of = "frames" if toy.are_frames(samples) else "embeddings"
        print_tables(scores_table(f"{kind.value} of random {of}", rows))
    if json is not None:
        outputs.write_json(json, outputs.samples_document(server, kind.value, outcomes))
    raise typer.Exit(options.exit_code_of(failures, some_succeeded=len(failures) < len(outcomes)))


@app.command(cls=OneLineCommand, epilog=EXIT_CODES)
def bench_input(
    context: typer.Context,
    output: Annotated[Path, typer.Option(help="JSON file to write.")],
    urls: options.Urls,
    kind: Kind = toy.SampleKind.progress,
    model: options.Model = DEFAULT_MODEL,
    num_samples: NumSamples = 64,
    num_frames: NumFrames = "8",
    use_frames: UseFrames = False,
    seed: Seed = 0,
    timeout: options.TimeoutS = DEFAULT_TIMEOUT_S,
) -> None:
    """Write made-up samples as input of Triton's perf_analyzer.

    It prints the command that measures with them.
    """
    from rfm_client.cli.perf_input import write_perf_analyzer_input

    made_up = _toy(kind, num_samples, num_frames, use_frames, seed)
    with Server(urls, model, timeout, context.obj).connected() as client:
        samples = made_up.samples(client)
        write_perf_analyzer_input(output, samples)
    protocol, address = split_url(urls[0])
    name = frames_name(model) if toy.are_frames(samples) else model
    arguments = [
        "perf_analyzer",
        "-m",
        name,
        "-i",
        protocol.removesuffix("s"),
        "-u",
        address,
        "--input-data",
        str(output),
    ]
    typer.echo(shlex.join([*arguments, "--async", "--concurrency-range", "1:16:5"]))


app.command(cls=OneLineCommand, epilog=EXIT_CODES)(label)


def _toy(kind: toy.SampleKind, num_samples: int, num_frames: str, use_frames: bool, seed: int) -> toy.Toy:
    with options.usage_errors("--num-frames"):
        return toy.Toy(kind, num_samples, toy.parse_lengths(num_frames), use_frames, seed)


def _check_panels(plot: Path | None, videos: Sequence[str]) -> None:
    if plot is not None and len(videos) > MAX_PANELS:
        raise typer.BadParameter(f"expected at most {MAX_PANELS} videos, got {len(videos)}", param_hint="--plot")


def _report_subsampled(name: str, num_scored: int, num_frames: int) -> None:
    if num_scored < num_frames:
        options.report(f"note: {name}: {num_scored} of {num_frames} frames were scored, evenly spaced")


def _add_gateway() -> None:
    """Adds the command of the distribution rfm-gateway; without that, one that says how to install it."""
    try:
        for found in entry_points(group="rfm_client.commands", name="gateway"):
            app.command(found.name, cls=OneLineCommand)(found.load())
            return
        reason = "rfm-gateway is not installed"
    except ImportError as error:
        reason = str(error)

    @app.command("gateway", context_settings={"ignore_unknown_options": True, "allow_extra_args": True})
    def gateway() -> None:
        """Serve the FastAPI server's endpoints before a Triton server; it needs rfm-gateway."""
        options.fail(f"gateway: {reason}: pip install ./client ./gateway", options.ExitCode.FAILED)


_add_gateway()
