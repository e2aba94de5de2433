# SPDX-License-Identifier: MIT
"""Pictures: film strips with curves of scores, and a summary of labels. Needs ``rfm-client[cli]``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rfm_client.contract.results import FrameScores
from rfm_client.contract.samples import Float32Array, UInt8Array
from rfm_client.plot import save

if TYPE_CHECKING:
    from matplotlib.figure import SubFigure

    from rfm_client.labelling.evaluation import LabelComparison
    from rfm_client.labelling.summary import Summary

STRIP_FRAMES = 8
WIDTH_IN = 10.0
COLUMN_WIDTH_IN = 7.0  # of panels side by side
PANEL_HEIGHT_IN = 4.0
SUMMARY_HEIGHT_IN = 3.5
SUMMARY_DOTS_PER_IN = 150
BINS = 20

_CURVES = (("progress", "tab:blue", "-", "o"), ("success", "tab:green", "--", "s"))


@dataclass(frozen=True, eq=False)
class Panel:
    """The part of a plot for one trajectory: T scored frames, and a strip of S frames of H x W pixels.

    positions: float64 [T], scored frames on the time axis
    unit: of the positions, ``s`` or ``frame``
    strip: uint8 [S, H, W, 3]; None: a trajectory of embeddings
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
        """Return the panel of a trajectory's scores. It keeps copies of only the frames that it shows.

        frames: uint8 [N, H, W, 3], all N frames that were read; None: embeddings
        times_s: float64 [N], times of these frames; None: unknown
        """
        scored = np.arange(len(scores.progress)) if scores.frame_indices is None else scores.frame_indices
        positions = scored.astype(np.float64) if times_s is None else times_s[scored]
        shown = np.unique(np.linspace(0, len(scored) - 1, STRIP_FRAMES).round().astype(int))
        strip = None if frames is None else frames[scored[shown]]
        return cls(title, scores, positions, "frame" if times_s is None else "s", strip, positions[shown])


def plot(file: Path, panels: Sequence[Panel], title: str | None = None, *, columns: int = 1) -> None:
    """Draw a picture, in the format of the file's suffix: for each panel a film strip, below it the scores.

    columns: panels side by side
    """
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('plots need matplotlib: pip install "./client[cli]"') from error

    rows = [panels[start : start + columns] for start in range(0, len(panels), columns)]
    heights_in = [PANEL_HEIGHT_IN * (1 if any(panel.strip is not None for panel in row) else 0.7) for row in rows]
    with matplotlib.rc_context({"text.parse_math": False}):
        figure = Figure(
            figsize=(WIDTH_IN if columns == 1 else COLUMN_WIDTH_IN * columns, sum(heights_in)), layout="constrained"
        )
        if title is not None:
            figure.suptitle(title)
        parts = figure.subfigures(len(rows), columns, squeeze=False, height_ratios=heights_in)
        for part, panel in zip(parts.flat, panels):  # noqa: B905 - the last row may have room left
            _draw(part, panel)
        save(figure, file)


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


def draw_summary(file: Path, summary: Summary) -> None:
    """Draw histograms of final progress and of steps backwards, and best success over final progress."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('pictures need matplotlib: pip install "./client[cli]", or use --no-picture') from error
    figure = Figure(figsize=(WIDTH_IN, SUMMARY_HEIGHT_IN), layout="constrained")
    final, by_success, backwards = figure.subplots(1, 3)
    bins = np.linspace(0, 1, BINS + 1).tolist()
    final.hist(summary.final_progress, bins=bins, color="tab:blue")
    final.set(xlabel="final progress", ylabel="episodes", xlim=(0, 1))
    if summary.best_success is None:
        by_success.text(0.5, 0.5, "success is not predicted", ha="center")
    else:
        by_success.scatter(summary.final_progress, summary.best_success, s=12, color="tab:green")
    by_success.set(
        xlabel="final progress", ylabel="best success of the episode", xlim=(-0.02, 1.02), ylim=(-0.02, 1.02)
    )
    backwards.hist(100 * summary.backwards, bins=BINS, color="tab:orange")
    backwards.set(xlabel="steps on which progress falls (%)", ylabel="episodes")
    figure.savefig(file, dpi=SUMMARY_DOTS_PER_IN)


def draw_evaluation(file: Path, comparison: LabelComparison) -> None:
    """Draw a histogram of final progress for each label file, successes and failures apart."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(WIDTH_IN, SUMMARY_HEIGHT_IN * len(comparison.evaluations) * 0.75), layout="constrained")
    axes = figure.subplots(len(comparison.evaluations), 1, sharex=True, sharey=True, squeeze=False)
    for ax, each in zip(axes.flat, comparison.evaluations, strict=True):
        parts = {"episodes": each.final_progress}
        if comparison.is_success is not None:
            parts = {
                "successes": each.final_progress[comparison.is_success],
                "failures": each.final_progress[~comparison.is_success],
            }
        colours = ["tab:green", "tab:red"] if len(parts) > 1 else ["tab:blue"]
        ax.hist([*parts.values()], bins=BINS, range=(0, 1), color=colours, label=[*parts], stacked=True)
        told = "" if each.spearman is None else f"   VOC {each.spearman:.2f}"
        told += "" if each.by_progress is None else f"   AUROC of progress {each.by_progress.auroc:.2f}"
        told += "" if each.by_success is None else f"   AUROC of success {each.by_success.auroc:.2f}"
        ax.set(title=f"{each.name}{told}", ylabel="episodes")
        ax.yaxis.set_major_locator(MaxNLocator(integer=True))
        ax.legend(loc="upper left")
    axes.flat[-1].set_xlabel("progress at the last frame")
    figure.savefig(file, dpi=SUMMARY_DOTS_PER_IN)
