# SPDX-License-Identifier: MIT
"""Draw a summary of labels, and an evaluation (needs matplotlib). Record episodes for Rerun (``rfm-client[rerun]``)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rfm_client import FrameScores
from rfm_client.recording import Recording
from rfm_labels.datasets.dataset import Dataset
from rfm_labels.evaluation import LabelComparison
from rfm_labels.metadata import PROGRESS, SUCCESS
from rfm_labels.plan import Item, Plan
from rfm_labels.summary import Summary
from rfm_labels.writing import Parts

WIDTH_IN = 10.0
HEIGHT_IN = 3.5
DOTS_PER_IN = 150
BINS = 20


def draw_summary(file: Path, summary: Summary) -> None:
    """Draw histograms of final progress and of steps backwards, and best success over final progress."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('pictures need matplotlib: pip install "./client[cli]", or use --no-picture') from error
    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
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
    figure.savefig(file, dpi=DOTS_PER_IN)


def draw_evaluation(file: Path, comparison: LabelComparison) -> None:
    """Draw a histogram of final progress for each label file, successes and failures apart."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN * len(comparison.evaluations) * 0.75), layout="constrained")
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
    figure.savefig(file, dpi=DOTS_PER_IN)


def record_episodes(folder: Path, dataset: Dataset, plan: Plan, parts: Parts) -> Iterator[Path]:
    """Write a file for each labelled episode of the plan, and yield its path. Frames are decoded again.

    Each of several cameras has its frames, and its own scores beside the fused scores.
    """
    folder.mkdir(parents=True, exist_ok=True)
    finished = parts.finished(plan.items)
    for item in plan.items:
        if item.key in finished:
            yield _record(folder, dataset, item, parts.read(item), plan.recipe.cameras)


def _record(folder: Path, dataset: Dataset, item: Item, labels: Any, cameras: Sequence[str]) -> Path:
    file = folder / f"episode_{item.episode.index:06d}.rrd"
    with Recording(file) as recording:
        videos = {camera: dataset.frames(item.episode, camera) for camera in cameras}
        recording.add((), _scores(labels, ""), videos if len(videos) > 1 else {"": videos[cameras[0]]})
        for camera in videos if len(videos) > 1 else ():
            recording.add((camera,), _scores(labels, f".{camera}"), {})
    return file


def _scores(labels: Any, suffix: str) -> FrameScores:
    """The columns of a part with this suffix; NaN: not predicted."""
    progress = labels[PROGRESS + suffix].to_numpy()
    name = SUCCESS + suffix
    success = labels[name].to_numpy() if name in labels.column_names else np.full_like(progress, np.nan)
    return FrameScores(progress=progress, success=success)
