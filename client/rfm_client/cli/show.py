# SPDX-License-Identifier: MIT
"""Scores and a server's state as a person would look at them: tables and a plot. Needs ``rfm-client[cli]``."""

from __future__ import annotations

import math
import textwrap
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rfm_client.contract.results import FrameScores, PreferenceResult, ProgressResult, Result
from rfm_client.contract.samples import Float32Array, UInt8Array
from rfm_client.transport.status import DEVICE_METRICS, Device, ModelStatus, ServerStatus

if TYPE_CHECKING:
    from matplotlib.figure import SubFigure
    from rich.console import Console, ConsoleOptions, RenderResult
    from rich.measure import Measurement
    from rich.table import Table

FILE_WIDTH = 200
SHORT_CELL = 16  # characters that a column of figures shows in any case
SHORTEST_NAME = 12
GAP = "..."
STRIP_FRAMES = 8
WIDTH_IN = 10.0
COLUMN_WIDTH_IN = 7.0  # where panels stand side by side
PANEL_HEIGHT_IN = 4.0
DOTS_PER_IN = 200
MAX_PANELS = 50  # one picture of more could not be looked at, nor drawn much further

STATUS_LEGEND = (
    "since load: since the model was loaded, warm-up included, as Triton's statistics count; since start: since Triton "
    "was started, as the model's metrics count, which go on where a model is loaded again. requests: answered with "
    "scores; failed: answered with an error, whoever is to blame; refused: samples that cannot be scored, the caller's "
    "fault. batches: since start of callers' samples, since load of all; queue ms: until a request's turn, on average "
    "in Triton since load and in the model since start. The server's log has the reason of each."
)

_GIB = 2**30
_CURVES = (("progress", "tab:blue", "-", "o"), ("success", "tab:green", "--", "s"))


def number(value: float | None, digits: int = 4) -> str:
    """The number, or ``-`` for one that is not predicted (None, NaN)."""
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def shortened(name: str, width: int) -> str:
    """The name in at most ``width`` characters: what is left out is in the middle, and no part of a file's own name."""
    if len(name) <= width or width <= len(GAP):
        return name[:width]
    kept = width - len(GAP)
    file_name = len(name) - max(name.rfind("/"), 0)  # with the slash before it
    end = file_name if kept // 2 <= file_name <= kept else kept - kept // 2
    return f"{name[: kept - end]}{GAP}{name[len(name) - end :]}"


@dataclass(frozen=True)
class Name:
    """A name or a path in a table, shortened to the room that the table has."""

    text: str

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        """Its narrowest and its full width."""
        from rich.measure import Measurement

        return Measurement(min(len(self.text), SHORTEST_NAME), len(self.text))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The name, as much of it as fits."""
        from rich.text import Text

        yield Text(shortened(self.text, options.max_width), no_wrap=True, overflow="ellipsis")


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], *, names: int = 1) -> Table:
    """A table of texts. What is in square brackets is text too, not markup.

    names: so many columns, the first ones, hold names and paths, which are shortened where there is no room. Of the
        others those with short cells are never broken, long ones wrap.
    """
    from rich import box
    from rich.table import Table
    from rich.text import Text

    shown = Table(
        box=box.SIMPLE_HEAD, collapse_padding=True, title=Text(title) if title else None, title_justify="left"
    )
    for index, column in enumerate(columns):
        widest = max((len(row[index]) for row in rows), default=0)
        is_short = index >= names and widest <= SHORT_CELL
        header = textwrap.fill(column, max(widest, *map(len, column.split()))) if is_short and column else column
        shown.add_column(Text(header), overflow="fold", no_wrap=is_short)
    for row in rows:
        shown.add_row(*map(Name, row[:names]), *map(Text, row[names:]))
    return shown


def print_tables(*tables: object) -> None:
    """Prints tables as wide as the terminal; into a file or a pipe, as wide as the content."""
    from rich.console import Console

    console = Console()
    console = console if console.is_terminal else Console(width=FILE_WIDTH)
    console.print(*tables, sep="\n", markup=False, highlight=False)


def scores_table(title: str, rows: Sequence[tuple[str, Result]]) -> Table:
    """One row a trajectory: its question's answer, and the scores of its last frame."""
    shown = []
    for name, result in rows:
        scored: tuple[tuple[str, FrameScores], ...]
        if isinstance(result, ProgressResult):
            answer, scored = f"{len(result.progress)} frames", (("", result),)
        elif isinstance(result, PreferenceResult):
            answer = f"P(first) = {result.preference:.4f}"
            scored = (": first", result.first), (": second", result.second)
        else:
            answer = f"similarity = {result.similarity:.4f}"
            scored = (": reference", result.reference), (": other", result.other)
        for (role, frames), told in zip(scored, (answer, ""), strict=False):
            shown.append((f"{name}{role}", told, number(frames.progress[-1]), number(frames.success[-1])))
    return table(title, ("sample", "answer", "progress at the end", "success at the end"), shown)


def status_tables(status: ServerStatus) -> list[Table | str]:
    """The server's models, their batches, what the figures mean, and the machine if its metrics describe it."""
    version = f" {status.version}" if status.version else ""
    title = f"{status.url}: Triton{version}, {'ready' if status.ready else 'not ready'}"
    requests = ("model", "v", "state", "requests since load", "failed since load", "refused since start", "pending now")
    batches = ("model", "v", "batches", "samples each", "ms each", "queue ms", "since")
    reasons = [f"{model.name} {model.version}: {model.reason}" for model in status.models if model.reason]
    shown: list[Table | str] = [
        table(title, requests, [_requests_row(model) for model in status.models]),
        *reasons,
        table("", batches, [_batches_row(model) for model in status.models]),
        STATUS_LEGEND,
        *filter(None, [status.metrics_error]),
    ]
    if status.devices:
        rows = [_device_row(device) for device in status.devices]
        shown += [
            "",
            table(f"machine, from {DEVICE_METRICS}", ("device", "utilization", "memory used", "memory"), rows),
        ]
    return shown


@dataclass(frozen=True, eq=False)
class Panel:
    """What a plot shows of one trajectory.

    positions: float64 [T], where each scored frame stands on the time axis
    unit: of the positions, ``s`` or ``frame``
    strip: uint8 [S, H, W, 3], some of the frames; None: the trajectory is of embeddings
    strip_positions: float64 [S]
    """

    title: str
    scores: FrameScores
    positions: npt.NDArray[np.float64]
    unit: str
    strip: UInt8Array | None
    strip_positions: npt.NDArray[np.float64]

    @classmethod
    def of(
        cls,
        title: str,
        scores: FrameScores,
        frames: UInt8Array | None = None,
        times_s: npt.NDArray[np.float64] | None = None,
    ) -> Panel:
        """The panel of a trajectory's scores, with all its frames and their times [T], as far as they are known.

        Of the frames it keeps only copies of those that it shows.
        """
        scored = np.arange(len(scores.progress)) if scores.frame_indices is None else scores.frame_indices
        positions = scored.astype(np.float64) if times_s is None else times_s[scored]
        shown = np.unique(np.linspace(0, len(scored) - 1, STRIP_FRAMES).round().astype(int))
        strip = None if frames is None else frames[scored[shown]]
        return cls(title, scores, positions, "frame" if times_s is None else "s", strip, positions[shown])


def plot(file: Path, panels: Sequence[Panel], title: str | None = None, *, columns: int = 1) -> None:
    """Writes a picture, in the format that the file's name ends in: per panel a film strip, and below it the scores.

    columns: panels that stand side by side
    """
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('plots need matplotlib: pip install "./client[cli]"') from error

    rows = [panels[start : start + columns] for start in range(0, len(panels), columns)]
    heights_in = [PANEL_HEIGHT_IN * (1 if any(panel.strip is not None for panel in row) else 0.7) for row in rows]
    with matplotlib.rc_context({"pdf.fonttype": 42, "text.parse_math": False}):  # fonts that journals take
        figure = Figure(
            figsize=(WIDTH_IN if columns == 1 else COLUMN_WIDTH_IN * columns, sum(heights_in)), layout="constrained"
        )
        if title is not None:
            figure.suptitle(title)
        parts = figure.subfigures(len(rows), columns, squeeze=False, height_ratios=heights_in)
        for part, panel in zip(parts.flat, panels):  # noqa: B905 - the last row may have room left
            _draw(part, panel)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Glyph")  # letters that the font lacks are drawn as boxes
            figure.savefig(file, dpi=DOTS_PER_IN)


def _draw(part: SubFigure, panel: Panel) -> None:
    columns = len(panel.strip_positions)
    if panel.strip is None:
        axes = part.add_subplot()
    else:
        grid = part.add_gridspec(2, columns, height_ratios=[1, 2])
        for column, (frame, position) in enumerate(zip(panel.strip, panel.strip_positions, strict=True)):
            picture = part.add_subplot(grid[0, column])
            picture.imshow(frame)
            picture.set_axis_off()
            picture.set_title(f"{position:.1f} s" if panel.unit == "s" else f"{position:.0f}", fontsize=8)
        axes = part.add_subplot(grid[1, :])
    for name, colour, line, marker in _CURVES:
        scores: Float32Array = getattr(panel.scores, name)
        if np.isnan(scores).all():
            axes.plot([], [], color=colour, label=f"{name}: not predicted")
        else:
            axes.plot(panel.positions, scores, color=colour, linestyle=line, marker=marker, markersize=4, label=name)
    axes.set(xlabel="time (s)" if panel.unit == "s" else "frame", ylabel="score", ylim=(-0.02, 1.02))
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", fontsize=8)
    part.suptitle(panel.title, fontsize=10)


def _requests_row(model: ModelStatus) -> tuple[str, ...]:
    refused, pending = (
        "-" if count is None else str(count) for count in (model.samples_refused, model.requests_pending)
    )
    return (
        model.name,
        model.version,
        model.state,
        str(model.requests_succeeded),
        str(model.requests_failed),
        refused,
        pending,
    )


def _batches_row(model: ModelStatus) -> tuple[str, ...]:
    return (
        model.name,
        model.version,
        str(model.batch_count),
        number(model.samples_per_batch, 1),
        number(model.compute_ms_per_batch, 2),
        number(model.queue_ms_per_request, 2),
        "start" if model.batches and model.batches.count else "load",
    )


def _device_row(device: Device) -> tuple[str, ...]:
    utilization = "-" if device.utilization is None else f"{device.utilization:.0%}"
    sizes = (device.memory_used_bytes, device.memory_total_bytes)
    return (device.name, utilization, *("-" if size is None else f"{size / _GIB:.1f} GiB" for size in sizes))
