# SPDX-License-Identifier: MIT
"""Draw label summaries and evaluations. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rfm_client.episodes import SuccessRule
from rfm_client.plot import save
from rfm_labels.evaluation import LabelComparison
from rfm_labels.label_files import read_provenance
from rfm_labels.summary import Summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN = 7.0  # page width
SUMMARY_IN, EVALUATION_IN = 1.9, 1.3  # axes heights
HEADLINE_IN = 0.5
BINS = 20
STYLE = "rfm_client.figure"  # the shared style file defines what each colour means
SUCCESS_COLOUR, UNDONE_COLOUR, FAILURE_COLOUR = "C2", "C1", "C6"  # matplotlib's default colour shows progress


def draw_summary(file: Path, summary: Summary, labels: Path) -> None:
    """Draw histograms (final progress, share of backward steps) and a scatter plot (best success over final progress).

    labels: label file; its metadata give the title
    """
    try:
        import matplotlib.style
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('pictures need matplotlib: pip install "./client[cli]", or use --no-picture') from error
    with matplotlib.style.context(STYLE, after_reset=True):
        figure = Figure(figsize=(WIDTH_IN, HEADLINE_IN + SUMMARY_IN), layout="constrained")
        final, by_success, backwards = figure.subplots(1, 3)
        coloured = dict(zip(summary.outcomes, (SUCCESS_COLOUR, UNDONE_COLOUR, FAILURE_COLOUR), strict=False))
        if summary.best_success is None:
            by_success.text(0.5, 0.5, "success is not predicted", ha="center")
        else:
            for outcome, has_it in summary.outcomes.items():
                ends = summary.final_progress[has_it], summary.best_success[has_it]
                by_success.scatter(*ends, s=10, c=coloured[outcome], alpha=0.6, lw=0, clip_on=False)
            by_success.axhline(
                SuccessRule.threshold, color=matplotlib.rcParams["axes.edgecolor"], linestyle=":", lw=0.9
            )
        _draw_ends(final, summary.final_progress, summary.outcomes, coloured)
        final.set_xlabel("final progress")
        by_success.set(xlabel="final progress", ylabel="best success", xlim=(0, 1), ylim=(-0.03, 1.03))
        by_success.set_yticks((0, 0.5, 1))
        backwards.hist(100 * summary.backwards, bins=BINS)
        backwards.set(xlabel="steps on which progress falls (%)", ylabel="episodes")
        for ax in (final, backwards):
            ax.grid(visible=False, axis="x")
            ax.yaxis.get_major_locator().set_params(integer=True)
        dataset, checkpoint = _origin(labels)
        _head(figure, f"{dataset}: {len(summary.episodes)} episodes", checkpoint)
        if coloured:
            figure.legend(*final.get_legend_handles_labels(), loc="outside lower left", ncols=len(coloured))
        save(figure, file)


def draw_evaluation(file: Path, comparison: LabelComparison, labels: Sequence[Path]) -> None:
    """Draw one histogram of final progress per label file, with successes and failures in different colours.

    labels: label file for each evaluation; their metadata give the titles
    """
    import matplotlib.style
    from matplotlib.figure import Figure

    count = len(comparison.evaluations)
    with matplotlib.style.context(STYLE, after_reset=True):
        figure = Figure(figsize=(WIDTH_IN, HEADLINE_IN + EVALUATION_IN * count), layout="constrained")
        axes = figure.subplots(count, 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        origins, known = [_origin(each) for each in labels], comparison.is_success
        outcomes = {} if known is None else {"successes": known, "failures": ~known}
        for ax, each, (_, checkpoint) in zip(axes, comparison.evaluations, origins, strict=True):
            _draw_ends(ax, each.final_progress, outcomes, {"successes": SUCCESS_COLOUR, "failures": FAILURE_COLOUR})
            measures = {
                "VOC": each.spearman,
                "AUROC of progress": each.by_progress and each.by_progress.auroc,
                "AUROC of success": each.by_success and each.by_success.auroc,
            }
            measured = [f"{name} {value:.2f}" for name, value in measures.items() if value is not None]
            ax.set_title(f"{each.name}: {checkpoint}" if checkpoint else each.name)
            ax.set_title("   ".join(measured), loc="right")
            ax.grid(visible=False, axis="x")
            ax.yaxis.get_major_locator().set_params(integer=True)
        axes[-1].set_xlabel("progress at the last frame")
        datasets = ", ".join(dict.fromkeys(dataset for dataset, _ in origins))
        _head(figure, f"{datasets}: {len(comparison.episodes)} episodes")
        if comparison.is_success is not None:
            figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower left", ncols=2)
        save(figure, file)


def _draw_ends(
    ax: Axes,
    final: npt.NDArray[Any],
    outcomes: Mapping[str, npt.NDArray[np.bool_]],
    colours: Mapping[str, str],
) -> None:
    """Draw a histogram of final progress. Stack known outcomes with the last one, failure, at the bottom."""
    if not outcomes:
        ax.hist(final, bins=BINS, range=(0, 1))
    else:
        names = [*outcomes][::-1]
        shares, shown = [final[outcomes[name]] for name in names], [colours[name] for name in names]
        ax.hist(shares, bins=BINS, range=(0, 1), color=shown, label=names, stacked=True)
    ax.set(ylabel="episodes", xlim=(0, 1))


def _head(figure: Figure, *lines: str) -> None:
    figure.suptitle("\n".join(filter(None, lines)), x=0.01, ha="left", fontsize=8)


def _origin(labels: Path) -> tuple[str, str]:
    """Return the dataset's and the checkpoint's source; the latter is empty if unknown."""
    provenance = read_provenance(labels)
    dataset, checkpoint = ((provenance.get(name) or {}).get("source") for name in ("dataset", "checkpoint"))
    return dataset or labels.parent.name, checkpoint or ""
