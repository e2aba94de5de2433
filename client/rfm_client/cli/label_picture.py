# SPDX-License-Identifier: MIT
"""The summary of a file of labels as a picture. Needs ``rfm-client[cli]``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rfm_client.labelling.summary import Summary

WIDTH_IN, HEIGHT_IN = 10.0, 3.5
DOTS_PER_IN = 150
BINS = 20


def draw_summary(file: Path, summary: Summary) -> None:
    """Writes a picture: how final progress is distributed, final progress by best success, steps that go backwards."""
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
