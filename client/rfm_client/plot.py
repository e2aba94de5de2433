# SPDX-License-Identifier: MIT
"""Plot score curves for several results, sized for a paper's column. Needs ``rfm-client[cli]`` (matplotlib)."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from rfm_client.contract.checks import require
from rfm_client.contract.results import FRAME_SCORES, SUCCESS_THRESHOLD, FrameScores

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_scores", "save"]

MAX_CURVES = 40  # colours times line styles
STYLE = ("default", "rfm_client.figure")  # figure.mplstyle sets colours, fonts and lines for every figure
COLOURS = {"progress": "C0", "success": "C2", "remaining_s": "C3"}  # colour by score, in a figure with one trajectory
THRESHOLD: dict[str, Any] = {
    "color": "#75808a",
    "linestyle": ":",
    "linewidth": 0.9,
    "zorder": 1,
    "label": f"success if last ≥ {SUCCESS_THRESHOLD}",
}  # the line from which success counts, as in ``FrameScores.succeeded``
GRID: dict[str, Any] = {"color": "#dde2e6", "linewidth": 0.5, "zorder": 0}
BOUNDS = (-0.03, 1.03)  # limits for an axis from 0 to 1


class Canvas(NamedTuple):
    """Size and resolution of a figure. Its text is 8 points high, so a larger canvas shows smaller text."""

    width_in: float
    height_in: float
    dpi: float

    def scaled(self, by: float) -> Canvas:
        """Return the canvas with more inches at the same number of pixels."""
        return Canvas(self.width_in * by, self.height_in * by, self.dpi / by)


Size: TypeAlias = Literal["paper", "slide", "square"]
_CANVASES = {"slide": Canvas(16 / 3, 3, 360), "square": Canvas(4, 4, 270)}  # at least 1920 and 1080 pixels wide
SCREEN_DPI = 100.0

_WIDTH_IN = 3.5  # one column in a two-column layout
_HEIGHT_IN = 1.5
_SUCCESS_IN = 0.7
_LINE_IN = 0.15  # one text line
_LONGEST = 44  # characters that fit in a one-column legend
_SHORT = 20  # characters that let two names fit side by side
_MOST_DOTS = 40  # on a curve, one for each scored frame; a longer curve has none
_LINES = ("-", "--", "-.", ":")


def plot_scores(
    results: Sequence[FrameScores],
    names: Sequence[str],
    *,
    title: str | None = None,
    times_s: Sequence[npt.NDArray[np.float64] | None] | None = None,
    size: Size = "paper",
) -> Figure:
    """Return a figure with one progress curve per result and, where success is predicted, success curves below.

    Models that predict another score instead of progress, such as remaining seconds, get an axis in that unit.

    The figure is light whatever style is set. A dotted line marks the success that counts. ``save`` writes the figure.
    ``matplotlib.style.use("rfm_client.figure")`` gives other figures the same style.

    names: curve names for the legend; long names lose their middle
    times_s: per result float64 [T], the times of the T scored frames; the axis counts frames if any are unknown
    size: paper: 3.5 inches wide, as high as needed; slide: 16:9; square: 1:1

    Raises ValueError for no results, for more than 40, and if the number of names or times differs; ImportError without
    matplotlib.
    """
    require("results", 0 < len(results) <= MAX_CURVES, f"1 to {MAX_CURVES}", len(results))
    times_s = [None] * len(results) if times_s is None else times_s
    for name, values in (("names", names), ("times_s", times_s)):
        require(name, len(values) == len(results), f"{len(results)}, as many as results", len(values))
    positions = [each for each in times_s if each is not None]
    has_times = len(positions) == len(results)
    if not has_times:
        positions = [result.scored_frames.astype(np.float64) for result in results]
    has_success = not all(np.isnan(result.success).all() for result in results)
    scores = [*dict.fromkeys(result.leading for result in results), *["success"] * has_success]
    heights_in = [_SUCCESS_IN if score == "success" else _HEIGHT_IN for score in scores]
    with drawing() as new_figure:
        from matplotlib import rcParams

        colours = rcParams["axes.prop_cycle"].by_key()["color"]  # "C0" would follow a style set later
        columns = 2 if max(map(len, names)) <= _SHORT else 1
        lines_in = _LINE_IN * (-(-(len(results) + has_success) // columns) + 3 + (title or "").count("\n"))
        needed_in = sum(heights_in) + lines_in
        canvas = Canvas(_WIDTH_IN, needed_in, SCREEN_DPI)
        if size != "paper":
            canvas = canvas_of(size, lambda each: each.height_in >= needed_in)
        figure = new_figure(figsize=canvas[:2], dpi=canvas.dpi, layout="constrained")
        axes = figure.subplots(len(heights_in), 1, sharex=True, squeeze=False, height_ratios=heights_in)[:, 0]
        for ax, score in zip(axes, scores, strict=True):
            for number, (result, x) in enumerate(zip(results, positions, strict=True)):
                if score not in ("success", result.leading):
                    continue
                # Gaps in a line show an equal one below it.
                colour, line = colours[number % len(colours)], _LINES[(number + number // len(colours)) % len(_LINES)]
                style = {"color": colour, "linestyle": line, "marker": "o" if len(x) <= _MOST_DOTS else ""}
                label = _shortened(names[number]) if score == result.leading else None
                values = getattr(result, score)
                known = ~np.isnan(values)  # the line skips frames without an answer
                ax.plot(x[known], values[known], label=label, clip_on=False, **style)
            about = FRAME_SCORES[score]
            ax.set_ylabel(about.title(score))
            if None not in about.bounds:
                ax.set(ylim=BOUNDS, yticks=(0, 0.5, 1))
            if score == "success":
                ax.axhline(SUCCESS_THRESHOLD, **THRESHOLD)
        figure.align_ylabels(axes)
        axes[-1].set_xlabel("time (s)" if has_times else "frame")
        if title is not None:
            figure.suptitle(title, x=0.01, ha="left", fontsize=8, wrap=True)
        figure.legend(loc="outside lower left", ncols=columns)
    return figure


def canvas_of(size: Size, fits: Callable[[Canvas], bool]) -> Canvas:
    """Return the canvas of a slide or square, enlarged until the contents fit, so that text looks smaller."""
    return next(filter(fits, (_CANVASES[size].scaled(quarters / 4) for quarters in itertools.count(4))))


@contextmanager
def drawing() -> Iterator[type[Figure]]:
    """Set the style, and yield matplotlib's class for figures. Raises ImportError, naming the extra to install."""
    try:
        import matplotlib.style
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('plots need matplotlib: pip install "./client[cli]"') from error
    with matplotlib.style.context([*STYLE]):
        yield Figure


def save(figure: Figure, file: Path | str) -> None:
    """Write a figure in the format given by the file suffix, such as .png (200 dots per inch or more), .pdf or .svg."""
    with drawing(), warnings.catch_warnings():
        from matplotlib import rcParams

        warnings.filterwarnings("ignore", message="Glyph")  # letters missing from the font appear as boxes
        figure.savefig(file, dpi=max(figure.dpi, rcParams["savefig.dpi"]))


def _shortened(name: str) -> str:
    half = _LONGEST // 2
    return name if len(name) <= _LONGEST else f"{name[: half - 1]}…{name[-half:]}"
