# SPDX-License-Identifier: MIT
"""Curves of several results in one figure, sized for a paper's column. Needs ``rfm-client[cli]`` (matplotlib)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rfm_client.contract.checks import require
from rfm_client.contract.results import FRAME_SCORES, FrameScores

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_scores", "save"]

MAX_CURVES = 40  # colours times line styles
DOTS_PER_IN = 200

_WIDTH_IN = 3.5  # a column of two
_HEIGHT_IN = 1.8
_SUCCESS_IN = 0.9
_LINE_IN = 0.17  # a line of text
_LONGEST = 44  # characters of a name that a column has room for
_COLOURS = tuple(f"C{index}" for index in range(10))
_LINES = ("-", "--", "-.", ":")
_STYLE = {"font.size": 8, "axes.titlesize": 8, "text.parse_math": False, "axes.grid": True, "grid.alpha": 0.3}


def plot_scores(
    results: Sequence[FrameScores],
    names: Sequence[str],
    *,
    title: str | None = None,
    times_s: Sequence[npt.NDArray[np.float64] | None] | None = None,
) -> Figure:
    """Return a figure with a curve of progress for each result and, below it, of success where it is predicted.

    Models that predict another score in place of progress, such as remaining seconds, have an axis in its unit.

    It is light, whatever style is set, and 3.5 inches wide. ``save`` writes it.

    names: of the curves, in the legend; long names lose their middle
    times_s: for each result float64 [T], the times of its T scored frames; the axis counts frames if one is unknown

    Raises ValueError for no result, for more than 40, and for another number of names or times; ImportError without
    matplotlib.
    """
    require("results", 0 < len(results) <= MAX_CURVES, f"1 to {MAX_CURVES}", len(results))
    times_s = [None] * len(results) if times_s is None else times_s
    for name, values in (("names", names), ("times_s", times_s)):
        require(name, len(values) == len(results), f"{len(results)}, as many as results", len(values))
    try:
        import matplotlib.style
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('plots need matplotlib: pip install "./client[cli]"') from error

    positions = [each for each in times_s if each is not None]
    has_times = len(positions) == len(results)
    if not has_times:
        positions = [result.scored_frames.astype(np.float64) for result in results]
    has_success = not all(np.isnan(result.success).all() for result in results)
    scores = [*dict.fromkeys(result.leading for result in results), *["success"] * has_success]
    heights_in = [_SUCCESS_IN if score == "success" else _HEIGHT_IN for score in scores]
    with matplotlib.style.context(["default", _STYLE]):
        figure = Figure(figsize=(_WIDTH_IN, sum(heights_in) + _LINE_IN * (len(results) + 2)), layout="constrained")
        axes = figure.subplots(len(heights_in), 1, sharex=True, squeeze=False, height_ratios=heights_in)[:, 0]
        for ax, score in zip(axes, scores, strict=True):
            for number, (result, x) in enumerate(zip(results, positions, strict=True)):
                if score not in ("success", result.leading):
                    continue
                colour, line = _COLOURS[number % len(_COLOURS)], _LINES[number // len(_COLOURS)]
                marker = "o" if len(x) == 1 else ""  # a point alone makes no line
                label = _shortened(names[number]) if score == result.leading else None
                values = getattr(result, score)
                known = ~np.isnan(values)  # the line passes over frames without an answer
                ax.plot(x[known], values[known], color=colour, linestyle=line, marker=marker, lw=1.2, label=label)
            about = FRAME_SCORES[score]
            ax.set(ylabel=about.title(score), **({} if None in about.bounds else {"ylim": (-0.02, 1.02)}))
        axes[-1].set_xlabel("time (s)" if has_times else "frame")
        if title is not None:
            figure.suptitle(title, fontsize=9, wrap=True)
        figure.legend(loc="outside lower left", fontsize=7, frameon=False)
    return figure


def save(figure: Figure, file: Path | str) -> None:
    """Write a figure in the format of the file's suffix, such as .png (200 dots an inch), .pdf or .svg."""
    import matplotlib

    with matplotlib.rc_context({"pdf.fonttype": 42}), warnings.catch_warnings():  # TrueType, which journals accept
        warnings.filterwarnings("ignore", message="Glyph")  # letters that the font lacks are drawn as boxes
        figure.savefig(file, dpi=DOTS_PER_IN)


def _shortened(name: str) -> str:
    half = _LONGEST // 2
    return name if len(name) <= _LONGEST else f"{name[: half - 1]}…{name[-half:]}"
