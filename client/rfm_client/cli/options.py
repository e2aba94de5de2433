# SPDX-License-Identifier: MIT
"""What all commands have in common: options, exit codes, errors on one line, the connection."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperCommand

from rfm_client.async_client import DEFAULT_TIMEOUT_S
from rfm_client.client import RewardClient
from rfm_client.contract import errors
from rfm_client.contract.names import DEFAULT_MODEL
from rfm_client.data.orientation import Orientation
from rfm_client.data.sampling import Rule, Sampling
from rfm_client.transport.access import Access

DEFAULT_URL = "grpc://localhost:8001"
STANDARD_OUTPUT = "-"
MIN_TIMEOUT_S, MAX_TIMEOUT_S = 0.001, 86_400
RECORDING = ".rrd"
PICTURES = (".png", ".pdf", ".svg")


class ExitCode(IntEnum):
    """How a command ended, for scripts."""

    OK = 0
    FAILED = 1
    USAGE = 2
    UNAVAILABLE = 3
    DEADLINE = 4
    NO_MODEL = 5
    INTERRUPTED = 130


EXIT_CODES = (
    "Exit codes: 0 done; 1 a sample (or anything not named here) failed; 2 wrong usage; 3 server unavailable; "
    "4 out of time; 5 model not served; 130 interrupted. Errors are written to standard error, one a line."
)

_ERROR_CODES: dict[type[BaseException], ExitCode] = {
    errors.ServerUnavailableError: ExitCode.UNAVAILABLE,
    errors.DeadlineExceededError: ExitCode.DEADLINE,
    errors.ModelNotFoundError: ExitCode.NO_MODEL,
}


def finite(value: float) -> float:
    """Refuses infinity and NaN, which are within any bounds. Raises typer.BadParameter."""
    if not math.isfinite(value):
        raise typer.BadParameter(f"expected a number, got {value}")
    return value


Urls = Annotated[
    list[str],
    typer.Option(
        "--url",
        envvar="RFM_URL",
        default_factory=lambda: [DEFAULT_URL],
        show_default=DEFAULT_URL,
        help="grpc://host:8001 or http://host:8000, with TLS grpcs:// or https://. Again for more servers of the same "
        "checkpoint.",
    ),
]
CaFile = Annotated[
    Path | None, typer.Option(envvar="RFM_CA_FILE", help="Authorities (PEM) to trust; else the system's.")
]
ClientCertificate = Annotated[
    Path | None,
    typer.Option(envvar="RFM_CLIENT_CERTIFICATE", help="Certificate that this client shows to the server (PEM)."),
]
ClientKey = Annotated[Path | None, typer.Option(envvar="RFM_CLIENT_KEY", help="The certificate's key (PEM).")]
ApiKeyFile = Annotated[
    Path | None, typer.Option(envvar="RFM_API_KEY_FILE", help="File with the key that requests show as Bearer.")
]
Model = Annotated[str, typer.Option("--model", help="Name under which the checkpoint was exported.")]
TimeoutS = Annotated[
    float,
    typer.Option(
        "--timeout", min=MIN_TIMEOUT_S, max=MAX_TIMEOUT_S, callback=finite, help="Seconds that a request may take."
    ),
]
Json = Annotated[
    str | None,
    typer.Option("--json", metavar="[FILE|-]", help="Write JSON to a .json file; alone or -: print it, and no table."),
]
Plot = Annotated[
    Path | None, typer.Option("--plot", metavar="FILE", help="Draw frames and scores: .png, .pdf or .svg.")
]
Recorded = Annotated[
    Path | None,
    typer.Option("--rrd", metavar="FILE", help="Record frames and scores on one timeline for Rerun's viewer: .rrd."),
]
Task = Annotated[str, typer.Option("--task", help="What is to be done, as a sentence.")]
Fps = Annotated[
    float, typer.Option("--fps", min=0.001, callback=finite, help="Frames a second that are taken from a video.")
]
Subsample = Annotated[
    bool, typer.Option(help="Score no more frames than the checkpoint was trained on, evenly spaced; else all.")
]
SamplingRule = Annotated[
    Rule | None,
    typer.Option("--sampling", help="Rule by which each frame is scored on its prefix (see docs/guides/sampling.md)."),
]
SampledFrames = Annotated[
    int | None,
    typer.Option("--frames", min=1, help="Frames that the rule shows the model; else as many as in training."),
]
Orient = Annotated[
    Orientation,
    typer.Option("--orient", help="Turn frames upright before they are scored (see docs/guides/label-a-dataset.md)."),
]
MaxFrames = Annotated[int | None, typer.Option(min=1, help="Score at most so many frames, evenly.")]
Resize = Annotated[bool, typer.Option("--resize", help="Make frames as small as the checkpoint reads them, then send.")]


class OneLineCommand(TyperCommand):
    """A command whose errors take one line and never a traceback, and whose ``--json`` may stand alone."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Gives a ``--json`` without a value the value ``-``, which the parser could not."""
        completed: list[str] = []
        for index, word in enumerate(args):
            completed.append(word)
            following = args[index + 1] if index + 1 < len(args) else "--"
            if word == "--json" and following.startswith("-") and following != STANDARD_OUTPUT:
                completed.append(STANDARD_OUTPUT)
        return super().parse_args(ctx, completed)

    def invoke(self, ctx: Any) -> Any:
        """Runs the command, and reports an error on one line."""
        with errors_on_one_line():
            return super().invoke(ctx)


@dataclass(frozen=True)
class Server:
    """The servers and model of a command, and how long a request may take."""

    urls: list[str]
    model: str = DEFAULT_MODEL
    timeout_s: float = DEFAULT_TIMEOUT_S
    access: Access = field(default_factory=Access)

    @contextmanager
    def connected(self) -> Iterator[RewardClient]:
        """A client, once one of the servers answers and serves the model. If none does, it fails without a wait."""
        with usage_errors("--url"):
            client = RewardClient(self.urls, model=self.model, timeout_s=self.timeout_s, **self.access.options)
        with client:
            self._check()
            yield client

    def _check(self) -> None:
        problems = []
        for url in self.urls:
            with RewardClient(
                url, model=self.model, timeout_s=self.timeout_s, retry=False, **self.access.options
            ) as client:
                try:
                    _check_served(client)
                    return
                except errors.RewardError as error:
                    problems.append(error)
        raise problems[0]


def read_access(ca_file: Path | None, certificate: Path | None, key: Path | None, key_file: Path | None) -> Access:
    """Reads the files. Raises typer.BadParameter."""
    with usage_errors("--ca-file, --client-certificate, --client-key, --api-key-file"):
        try:
            api_key = None if key_file is None else key_file.read_text().strip()
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"expected a text file, got {error}") from None
        return Access(ca_file, certificate, key, api_key=api_key)


def exit_code(error: BaseException) -> ExitCode:
    """The exit code of a command that fails with this error."""
    return next((code for kind, code in _ERROR_CODES.items() if isinstance(error, kind)), ExitCode.FAILED)


def exit_code_of(failures: Sequence[Exception], *, some_succeeded: bool) -> ExitCode:
    """The exit code of a command of whose samples some failed: a special one only if all failed for that one reason."""
    codes = {exit_code(error) for error in failures}
    if not codes:
        return ExitCode.OK
    return codes.pop() if len(codes) == 1 and not some_succeeded else ExitCode.FAILED


def report(message: str) -> None:
    """Writes the message as one line to standard error."""
    print(f"rfm-client: {' '.join(message.split())}", file=sys.stderr, flush=True)  # above a progress bar, if any


def fail(message: str, code: ExitCode) -> NoReturn:
    """Reports the message and ends the command."""
    report(message)
    raise typer.Exit(code)


@contextmanager
def usage_errors(option: str) -> Iterator[None]:
    """A ValueError becomes wrong usage of ``option``."""
    try:
        yield
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint=option) from error


@contextmanager
def errors_on_one_line() -> Iterator[None]:
    """Whatever can be expected to go wrong ends the command with a line and its exit code."""
    try:
        yield
    except KeyboardInterrupt:
        fail("interrupted", ExitCode.INTERRUPTED)
    except BrokenPipeError:  # the reader of the output has closed the pipe
        raise
    except ImportError as error:
        fail(missing_package(error), ExitCode.FAILED)
    except (errors.RewardError, OSError) as error:
        fail(str(error), exit_code(error))


def missing_package(error: ImportError) -> str:
    """What is missing, with the command that installs it."""
    return str(error) if "pip install" in str(error) else f'{error}: pip install "./client[cli]"'


def check_outputs(json: str | None, plot: Path | None, rrd: Path | None = None) -> None:
    """Checks, before the first request, that results can be written. Raises typer.BadParameter."""
    if json is not None and json != STANDARD_OUTPUT and Path(json).suffix != ".json":
        raise typer.BadParameter(f"expected a .json file or -, got {json}", param_hint="--json")
    if plot is not None and plot.suffix not in PICTURES:
        raise typer.BadParameter(f"expected a file that ends in {', '.join(PICTURES)}, got {plot}", param_hint="--plot")
    if rrd is not None and rrd.suffix != RECORDING:
        raise typer.BadParameter(f"expected a file that ends in {RECORDING}, got {rrd}", param_hint="--rrd")
    for option, file in (("--json", json), ("--plot", plot), ("--rrd", rrd)):
        if file is not None and not Path(file).parent.is_dir():
            raise typer.BadParameter(f"expected a folder at {Path(file).parent}, got none", param_hint=option)


def check_sampling(rule: Rule | None, frames: int | None, *, others: Mapping[str, object]) -> None:
    """Checks that the rule takes the number of frames. Raises typer.BadParameter.

    others: values of options that say otherwise which frames are scored, by their names
    """
    if rule is None:
        if frames is not None:
            raise typer.BadParameter("expected --sampling with it, got none", param_hint="--frames")
        return
    for option, value in others.items():
        if value:
            raise typer.BadParameter(f"expected no {option} with it, got {value}", param_hint="--sampling")
    with usage_errors("--frames"):
        Sampling.of(rule, frames, trained_frames=1)


def _check_served(client: RewardClient) -> None:
    try:
        client.model_info()
    except errors.ModelNotFoundError:
        client.model_info(frames=True)
