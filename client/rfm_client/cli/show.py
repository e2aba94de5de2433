# SPDX-License-Identifier: MIT
"""Tables of scores and of a server's state, and what to try next, as commands to copy. Needs ``rfm-client[cli]``."""

from __future__ import annotations

import itertools
import math
import os
import shlex
import shutil
import sys
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rfm_client.cli.options import DEFAULT_URL
from rfm_client.contract.results import (
    FRAME_SCORES,
    FrameScores,
    PreferenceResult,
    ProgressResult,
    Result,
    trajectory_scores,
)
from rfm_client.contract.wire import DEFAULT_MODEL
from rfm_client.transport.status import Device, ServerStatus

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
    from rich.measure import Measurement
    from rich.table import Table

FILE_WIDTH = 200
SHORT_CELL = 16  # characters; a column without longer cells does not wrap
SHORTEST_NAME = 12
UNLIMITED = 10_000  # columns
CUT = "..."  # for the left-out part of a name
GAP = "  "  # between columns of a ``StreamedTable``

_GIB = 2**30


def number(value: float | None, digits: int = 4) -> str:
    """Return the number as text; ``-`` for None and NaN, which mean not predicted."""
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def at_end(scores: FrameScores) -> str:
    """Return progress at the last frame as text, or what the model predicts in its place, with the unit."""
    last, unit = float(scores.arrays[scores.leading][-1]), FRAME_SCORES[scores.leading].unit
    return f"{number(last, 2)} {unit}" if unit else number(last)


def in_place_of_progress(results: Iterable[FrameScores]) -> str:
    """Return a sentence about numbers that stand in place of progress; empty: none do."""
    instead = [FRAME_SCORES[name] for name in sorted({result.leading for result in results} - {"progress"})]
    return " ".join(f"In {score.unit}, in place of progress: {score.meaning.lower()}." for score in instead)


def shortened(name: str, width: int) -> str:
    """Return the name in at most ``width`` characters, without its middle; a file's own name stays if it fits."""
    if len(name) <= width or width <= len(CUT):
        return name[:width]
    kept = width - len(CUT)
    file_name = len(name) - max(name.rfind("/"), 0)  # with the slash before it
    end = file_name if kept // 2 <= file_name <= kept else kept - kept // 2
    return f"{name[: kept - end]}{CUT}{name[len(name) - end :]}"


@dataclass(frozen=True)
class ShortName:
    """A name or a path in a table, shortened to fit."""

    text: str

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        """Return the narrowest and the full width."""
        from rich.measure import Measurement

        return Measurement(min(len(self.text), SHORTEST_NAME), len(self.text))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the name, shortened to fit."""
        from rich.text import Text

        yield Text(shortened(self.text, options.max_width), no_wrap=True, overflow="ellipsis")


@dataclass(frozen=True)
class FittingTable:
    """A table whose headers stand on one line where they fit. Of too many columns, some stand in tables below.

    wide, narrow: headers on one line, and as narrow as their columns
    names, are_short: as ``table`` makes them of its arguments
    """

    title: str
    wide: Sequence[str]
    narrow: Sequence[str]
    rows: Sequence[Sequence[str]]
    names: int
    are_short: Sequence[bool]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the table with wide headers if it fits, else with narrow ones, in parts if a cell were cut."""
        from rich.measure import Measurement

        def measured(shown: Table) -> Measurement:
            return Measurement.get(console, options.update(max_width=UNLIMITED), shown)

        begin, end = self.names, len(self.wide)
        if measured(whole := self._part(self.wide, begin, end)).maximum <= options.max_width:
            yield whole
            return
        while True:
            parts = (self._part(self.narrow, begin, last) for last in range(end, begin, -1))
            fitting = (each for each in parts if measured(each).minimum <= options.max_width)
            yield (part := next(fitting, self._part(self.narrow, begin, begin + 1)))
            begin += len(part.columns) - self.names
            if begin >= end:
                return

    def _part(self, headers: Sequence[str], begin: int, end: int) -> Table:
        """Return a table of the names and these columns; the title stands above the first."""
        from rich import box
        from rich.table import Table
        from rich.text import Text

        title = Text(self.title) if self.title and begin == self.names else None
        shown = Table(box=box.SIMPLE_HEAD, collapse_padding=True, title=title, title_justify="left")
        columns = [*range(self.names), *range(begin, min(end, len(headers)))]
        for column in columns:
            shown.add_column(Text(headers[column]), overflow="fold", no_wrap=self.are_short[column])
        for row in self.rows:
            shown.add_row(*(ShortName(row[each]) if each < self.names else Text(row[each]) for each in columns))
        return shown


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], *, names: int = 1) -> FittingTable:
    """Return a table of plain texts: square brackets are no markup.

    names: number of first columns with names and paths, which are shortened to fit; of the other columns, only those
        with long cells wrap
    """
    widest = [max((len(row[index]) for row in rows), default=0) for index in range(len(columns))]
    are_short = [index >= names and width <= SHORT_CELL for index, width in enumerate(widest)]
    folded = [
        textwrap.fill(column, max(width, *map(len, column.split()))) if is_short and column else column
        for column, width, is_short in zip(columns, widest, are_short, strict=True)
    ]
    return FittingTable(title, columns, folded, rows, names, are_short)


def print_tables(*tables: object) -> None:
    """Print tables as wide as the terminal; to a file or a pipe, as wide as the content, at most FILE_WIDTH."""
    from rich.console import Console

    console = Console()
    console = console if console.is_terminal else Console(width=FILE_WIDTH)
    console.print(*tables, sep="\n", markup=False, highlight=False)


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], *, names: int = 1) -> None:
    """Print the table that ``table`` returns."""
    print_tables(table(title, columns, rows, names=names))


class StreamedTable:
    """A table on standard output, written row by row, as wide as the terminal.

    columns: headers and widths; the first column is as wide as ``names`` need and the terminal allows
    names: all cells of the first column
    """

    def __init__(self, columns: Sequence[tuple[str, int]], names: Sequence[str]) -> None:
        from rich.console import Console

        console = Console()
        self._headers, widths = zip(*columns, strict=True)
        room = (console.width if console.is_terminal else FILE_WIDTH) - sum(widths) - len(GAP) * len(columns)
        self._widths = [max(SHORTEST_NAME, min(max(map(len, names)), room)), *widths[1:]]
        self._is_begun = False

    def write(self, cells: Sequence[str]) -> None:
        """Write a row at once; before the first, the headers."""
        lines: list[Sequence[str]] = [[shortened(cells[0], self._widths[0]), *cells[1:]]]
        if not self._is_begun:
            self._is_begun = True
            headers = [textwrap.wrap(header, width) for header, width in zip(self._headers, self._widths, strict=True)]
            lines = [*itertools.zip_longest(*headers, fillvalue=""), ["-" * width for width in self._widths], *lines]
        for line in lines:
            row = GAP.join(cell.ljust(width) for cell, width in zip(line, self._widths, strict=True))
            print(f"{GAP}{row}".rstrip(), flush=True)

    def end(self, text: str) -> None:
        """Write a line below the table, if it has a row."""
        if self._is_begun:
            print(f"\n{GAP}{text}", flush=True)


def scores_table(title: str, rows: Sequence[tuple[str, Result]]) -> FittingTable:
    """Return a table with a row for each trajectory: its sample's answer, and the scores of its last frame."""
    shown = []
    for name, result in rows:
        if isinstance(result, ProgressResult):
            told = f"{len(result.progress)} frames"
        elif isinstance(result, PreferenceResult):
            told = f"P(first) = {result.preference:.4f}"
        else:
            told = f"similarity = {result.similarity:.4f}"
        for role, frames in trajectory_scores(result).items():
            row = ": ".join(filter(None, (name, role)))
            shown.append((row, told, at_end(frames), number(frames.success[-1])))
            told = ""
    return table(title, ("sample", "answer", "progress at the end", "success at the end"), shown)


def status_tables(status: ServerStatus) -> list[RenderableType]:
    """Return tables of models, of their batches, and of the machine if its metrics describe it."""
    version = f" {status.version}" if status.version else ""
    title = f"{status.url}: Triton{version}, {'ready' if status.ready else 'not ready'}"
    requests = ("model", "v", "state", "requests since load", "failed since load", "refused since start", "pending now")
    batches = ("model", "v", "batches", "samples each", "ms each", "queue ms", "since")
    counted, batched = [], []
    for model in status.models:
        counts = model.requests_succeeded, model.requests_failed, model.samples_refused, model.requests_pending
        counted.append((model.name, model.version, model.state, *(number(count, 0) for count in counts)))
        times = number(model.compute_ms_per_batch, 2), number(model.queue_ms_per_request, 2)
        each, since = number(model.samples_per_batch, 1), "start" if model.batches and model.batches.count else "load"
        batched.append((model.name, model.version, str(model.batch_count), each, *times, since))
    shown: list[RenderableType] = [
        table(title, requests, counted),
        *(f"{model.name} {model.version}: {model.reason}" for model in status.models if model.reason),
        table("", batches, batched),
        *filter(None, [status.metrics_error]),
    ]
    if status.devices:
        columns = ("device", "utilization", "memory used", "memory")
        shown += [table("machine", columns, [_device_row(each) for each in status.devices])]
    return shown


def _device_row(device: Device) -> tuple[str, ...]:
    utilization = "-" if device.utilization is None else f"{device.utilization:.0%}"
    sizes = (device.memory_used_bytes, device.memory_total_bytes)
    return (device.name, utilization, *("-" if size is None else f"{size / _GIB:.1f} GiB" for size in sizes))


DEFAULT_URLS = (DEFAULT_URL, DEFAULT_URL.replace("localhost", "127.0.0.1"))
PAGE_PORT = 8100
PAGE_URL = f"http://localhost:{PAGE_PORT}/"


def command(program: str, *words: object) -> str:
    """Return the command line to type: the program by name, or by path if its environment is not active."""
    beside = Path(sys.executable).with_name(program)
    if shutil.which(program) is None and beside.exists():
        program = os.path.relpath(beside) if beside.is_relative_to(Path.cwd()) else str(beside)
    return shlex.join([program, *map(str, words)])


def next_steps(*steps: tuple[str, str]) -> str:
    """Return lines for the user. steps: the purpose of each command, and the command"""
    return "\n".join(["Next:", *(f"  # {purpose}\n  {line}" for purpose, line in steps)])


def score_step(url: str, models: Sequence[str]) -> tuple[str, str]:
    """Return how to score something with a running server. models: those that score frames"""
    options = [] if url in DEFAULT_URLS else ["--url", url]
    if not models:
        return "score random embeddings", command("rfm-client", "sample", *options)
    options += [] if DEFAULT_MODEL in models else ["--model", models[0]]
    return "score a video", command("rfm-client", "score", "VIDEO", "--task", "TASK", *options)


def steps_with_server(url: str, models: Sequence[str]) -> str:
    """Return what to try with a running server. models: those that score frames"""
    steps = [score_step(url, models)]
    if models:
        options = [] if DEFAULT_MODEL in models else ["--model", models[0]]
        page = command("rfm-client", "gateway", "--port", PAGE_PORT, "--triton", url, *options)
        steps.append((f"serve the page at {PAGE_URL}", page))
    return next_steps(*steps)
