# SPDX-License-Identifier: MIT
"""Draw evaluations. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rfm_client.options import counted
from rfm_client.plot import save
from rfm_labels.evaluation import LabelComparison
from rfm_labels.label_files import read_provenance

WIDTH_IN = 7.0  # page width
AXES_IN = 1.3  # height
HEADLINE_IN, NOTE_IN = 0.5, 0.13
BINS = 20
STYLE = "rfm_client.figure"  # the shared style file defines what each colour means
SUCCESS_COLOUR, FAILURE_COLOUR = "C0", "C1"  # blue and orange, which colour-blind people tell apart


def draw_evaluation(file: Path, comparison: LabelComparison, labels: Sequence[Path]) -> None:
    """Draw one histogram of final progress per label file, with successes and failures in different colours.

    labels: label file for each evaluation; their metadata give the titles
    """
    import matplotlib.style
    from matplotlib.figure import Figure

    count = len(comparison.evaluations)
    with matplotlib.style.context(STYLE, after_reset=True):
        height_in = HEADLINE_IN + NOTE_IN * len(comparison.notes) + AXES_IN * count
        figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
        axes = figure.subplots(count, 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        origins, known = [_origin(each) for each in labels], comparison.is_success
        for ax, each, (_, checkpoint) in zip(axes, comparison.evaluations, origins, strict=True):
            ends, colours, names = [each.final_progress], None, None
            if known is not None:
                ends = [each.final_progress[~known], each.final_progress[known]]
                colours, names = [FAILURE_COLOUR, SUCCESS_COLOUR], ["failures", "successes"]
            ax.hist(ends, bins=BINS, range=(0, 1), color=colours, label=names, stacked=True)
            ax.set(ylabel="episodes", xlim=(0, 1))
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
        title = "\n".join([f"{datasets}: {counted(len(comparison.episodes), 'episode')}", *comparison.notes])
        figure.suptitle(title, x=0.01, ha="left", fontsize=8)
        if known is not None:
            figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower left", ncols=2)
        save(figure, file)


def _origin(labels: Path) -> tuple[str, str]:
    """Return the dataset's and the checkpoint's source; the latter is empty if unknown."""
    provenance = read_provenance(labels)
    dataset, checkpoint = ((provenance.get(name) or {}).get("source") for name in ("dataset", "checkpoint"))
    return dataset or labels.parent.name, checkpoint or ""
