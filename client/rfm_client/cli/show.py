# SPDX-License-Identifier: MIT
"""Tables for scores and server status, and next steps as commands to copy. Needs ``rfm-client[cli]``."""

from __future__ import annotations

import itertools
import math
import os
import shlex
import shutil
import sys
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

from rfm_client.cli.options import DEFAULT_URL
from rfm_client.contract.checks import counted
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

GAP = "  "  # between columns

_GIB = 2**30


def number(value: float | None, digits: int = 4) -> str:
    """Return the number as text; ``-`` for None and NaN, which mean not predicted."""
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def at_end(scores: FrameScores) -> str:
    """Return progress at the last frame as text, or what the model predicts instead."""
    return number(float(scores.arrays[scores.leading][-1]), 2 if FRAME_SCORES[scores.leading].unit else 4)


def title_at_end(scores: FrameScores) -> str:
    """Return the header for ``at_end``: ``final progress``, or ``final remaining (s)``."""
    return f"final {FRAME_SCORES[scores.leading].title(scores.leading)}"


def _room() -> int:
    """The columns of the terminal, or COLUMNS; a file or pipe has room for any line."""
    return shutil.get_terminal_size((sys.maxsize, 0)).columns


def wrapped(text: str, first: str = "", others: str = "") -> str:
    """Return the text in lines that fit the terminal, without breaking words. first, others: begin the lines"""
    lines = textwrap.TextWrapper(
        _room(), initial_indent=first, subsequent_indent=others, break_long_words=False, break_on_hyphens=False
    )
    return lines.fill(text)


class Table:
    """A plain table. Headers wrap to fit their columns. No cell is cut.

    columns: headers
    cells: all cells in each column, or stand-ins of the same width

    If the table does not fit the terminal, its first column, names and paths, stands on lines of its own, above the
    row's other cells.
    """

    def __init__(self, columns: Sequence[str], cells: Sequence[Iterable[str]]) -> None:
        self._columns, self._above = columns, 0
        headed = zip(columns, cells, strict=True)
        self._widths = [max(map(len, (*head.split(), *column, ""))) for head, column in headed]
        if not self.fits:
            self._above, self._widths = 1, self._widths[1:]

    @property
    def fits(self) -> bool:
        """True if the columns fit the terminal."""
        return sum(self._widths) + len(GAP) * (len(self._widths) + bool(self._above)) <= _room()

    @property
    def head(self) -> list[str]:
        """The lines above the rows."""
        heads = zip(self._columns[self._above :], self._widths, strict=True)
        words = (textwrap.wrap(head, max(width, 1))[::-1] for head, width in heads)
        first, *others = [*itertools.zip_longest(*words, fillvalue="")][::-1]
        rule = self._line(["-" * width for width in self._widths])
        return [self.row([*self._columns[: self._above], *first]), *map(self._line, others), rule]

    def row(self, cells: Sequence[str]) -> str:
        """Return a table row with headers or cells."""
        return "\n".join([*(f"{GAP}{name}" for name in cells[: self._above]), self._line(cells[self._above :])])

    def _line(self, cells: Sequence[str]) -> str:
        padded = (cell.ljust(width) for cell, width in zip(cells, self._widths, strict=True))
        return f"{GAP * (2 if self._above else 1)}{GAP.join(padded)}".rstrip()


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a ``Table`` below a title, if given. Columns that do not fit follow below, after the names."""
    lines, begin = [wrapped(title)] * bool(title), 1
    while begin < len(columns):
        for end in range(len(columns), begin, -1):
            shown = [0, *range(begin, end)]
            part = [[row[column] for column in shown] for row in (columns, *rows)]
            made = Table(part[0], [*zip(*part[1:], strict=True)] or [()] * len(shown))
            if made.fits:
                break
        lines += [*made.head, *map(made.row, part[1:]), ""]
        begin = end
    return "\n".join(lines)


def print_facts(rows: Sequence[tuple[str, str]]) -> None:
    """Print names and values, one pair a line, ``-`` for an empty value; long values wrap."""
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print(wrapped(value or "-", f"{GAP}{name:{width}}{GAP}", " " * (width + 2 * len(GAP))))


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], legend: str = "") -> None:
    """Print the table that ``table`` returns, and a legend."""
    print(table(title, columns, rows) + f"\n{wrapped(legend)}" * bool(legend))


def scores_table(title: str, rows: Sequence[tuple[str, Result]]) -> str:
    """Return a table with a row for each trajectory: its sample's answer, and the last frame's scores."""
    shown = []
    for name, result in rows:
        if isinstance(result, ProgressResult):
            answer = counted(len(result.progress), "frame")
        elif isinstance(result, PreferenceResult):
            answer = f"P(first) = {result.preference:.4f}"
        else:
            answer = f"similarity = {result.similarity:.4f}"
        for role, frames in trajectory_scores(result).items():
            row = ": ".join(filter(None, (name, role)))
            shown.append((row, answer, at_end(frames), number(frames.success[-1])))
            answer = ""
    return table(title, ("sample", "answer", title_at_end(frames), "final success"), shown)


def status_tables(status: ServerStatus) -> str:
    """Return tables for models, their batches, and the machine if its metrics describe it."""
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
    shown = [
        table(title, requests, counted),
        *(f"{model.name} {model.version}: {model.reason}" for model in status.models if model.reason),
        table("", batches, batched),
        *map(wrapped, filter(None, [status.metrics_error])),
    ]
    if status.devices:
        columns = ("device", "utilization", "memory used", "memory")
        shown += [table("machine", columns, [_device_row(each) for each in status.devices])]
    return "\n".join(shown)


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
    """Return lines for the user. steps: pairs of purpose and command."""
    return "\n".join(["Next:", *(f"  # {purpose}\n  {line}" for purpose, line in steps)])


def score_step(url: str, models: Sequence[str], *more: str) -> tuple[str, str]:
    """Return how to score something with a running server. models: those that score frames; more: further options"""
    options = [] if url in DEFAULT_URLS else ["--url", url]
    if not models:
        return "score random embeddings", command("rfm-client", "sample", *options, *more)
    options += [] if DEFAULT_MODEL in models else ["--model", models[0]]
    return "score a video", command("rfm-client", "score", "VIDEO", "--task", "TASK", *options, *more)
