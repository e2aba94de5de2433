# SPDX-License-Identifier: MIT
"""``rfm-client evaluate``: compare reward models by their label files to see which one suits a dataset."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rfm_client.command_line import JsonOutput, number, print_table, report, with_options
from rfm_client.options import counted, first_names, setting

if TYPE_CHECKING:
    from rfm_labels import LabelComparison

VOC = "VOC: rank correlation of progress with time, mean over {}; no VOC: episodes of constant progress. "
BY_OUTCOME = (
    "AUROC: of success, by the vote of the last three frames, and of progress at the last frame; 0.5 is chance. "
    "Threshold: of the vote, or else of progress, with the best balanced accuracy. "
)
FALLS = "Falls: steps on which progress falls by more than 0.01."


@dataclass(frozen=True)
class EvaluationOutput(JsonOutput):
    """Output files for an evaluation."""

    plot: Path | None = setting(
        None, "Draw histograms of progress at the last frame: .png, .pdf or .svg.", metavar="FILE"
    )


@with_options
def evaluate(
    dataset: Annotated[Path, typer.Argument(metavar="DATASET", help="Folder or HDF5 file of the labelled dataset.")],
    output: EvaluationOutput,
    labels: Annotated[
        list[Path] | None,
        typer.Option(
            help="Label file. Repeat for more. Default: all of DATASET.",
            show_default=False,
        ),
    ] = None,
    outcome: Annotated[
        str | None,
        typer.Option(
            help="Outcomes of the episodes: a CSV file (episode, success), a column of a LeRobot dataset, an attribute "
            "or array of each demonstration in HDF5, or a reader.",
            metavar="NAME|FILE.csv|FILE.py:FUNCTION",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Compare reward models by their labels of one dataset.

    With outcomes, successes and failures are told apart. Labels are those of `rfm-client label --name NAME`.

    Example: rfm-client evaluate my_dataset --outcome outcomes.csv
    """
    from rfm_labels import DatasetError, evaluate_labels, find_label_files, read_outcomes
    from rfm_labels.datasets.stored_files import digest_of
    from rfm_labels.label_files import read_names, reward_name

    output.begin()
    if not dataset.exists():
        raise DatasetError.at(dataset, "a labelled dataset", "no file or folder of this name")
    known: dict[str, Path] = {}
    there = () if labels else find_label_files(dataset)
    first = {file: known.setdefault(digest_of([file.read_bytes()]), file) for file in there}  # an alias is a copy
    files = labels or list(dict.fromkeys(first.values()))
    if not files:
        expected = "label files, NAME_progress.parquet (rfm-client label), or --labels"
        raise DatasetError.at(dataset, expected, "none")
    outcomes = None if outcome is None else read_outcomes(outcome, dataset, read_names(*files))
    comparison = evaluate_labels(files, outcomes)
    if output.prints_tables:
        _print_tables(comparison)
    same = [f"{reward_name(file)}: a copy of {reward_name(each)}" for file, each in first.items() if file != each]
    notes = [*same, *comparison.notes]
    for note in notes:
        report(f"note: {note}")
    output.write_json(document(comparison) | {"notes": notes})
    if output.plot is not None:
        from rfm_labels.pictures import draw_evaluation

        draw_evaluation(output.plot, comparison, files)


def _print_tables(comparison: LabelComparison) -> None:
    """Print a row for each label file, and a legend."""
    known, rows = comparison.is_success, []
    columns = ["labels", "VOC rho", "VOC tau", "no VOC", "final", "falls"]
    if known is not None:
        columns[5:5] = [
            "of successes",
            "of failures",
            "AUROC success",
            "AUROC progress",
            "threshold",
            "balanced accuracy",
        ]
    for each in comparison.evaluations:
        cells = [each.name, number(each.spearman), number(each.kendall), str(each.num_constant), number(each.final)]
        if known is not None:
            aurocs = [None if ranking is None else ranking.auroc for ranking in (each.by_success, each.by_progress)]
            cells += map(number, (each.final_of_successes, each.final_of_failures, *aurocs))
            best = each.by_success or each.by_progress
            cells += ["-", "-"] if best is None else [_exact(best.threshold), number(best.balanced_accuracy)]
        rows.append([*cells, f"{each.backwards:.1%}"])
    counts = counted(len(comparison.episodes), "episode")
    if known is not None:
        counts += f": {counted(int(known.sum()), 'success')}, {counted(int((~known).sum()), 'failure')}"
    if comparison.num_left_out:
        lacking = first_names(comparison.lacking)
        counts += f"; {comparison.num_left_out} left out, not in {lacking} (--labels chooses the files)"
    if comparison.num_without_outcome:
        counts += f"; {comparison.num_without_outcome} left out, whose outcome is unknown"
    if comparison.without_labels:
        unused = counted(len(comparison.without_labels), "outcome")
        counts += f"; {unused} unused, of episodes without labels: {first_names(comparison.without_labels)}"
    legend = VOC.format("all episodes") if known is None else VOC.format("successes") + BY_OUTCOME
    print_table(counts, columns, rows, legend + FALLS)


def _exact(threshold: float) -> str:
    """Return the threshold with four decimals, or with all that separate it from its neighbours."""
    return number(threshold) if round(threshold, 4) == threshold else str(threshold)


def document(comparison: LabelComparison) -> dict[str, Any]:
    """Return the document for ``evaluate --json``."""
    is_success = comparison.is_success
    evaluations = [{**asdict(each), "final_progress": each.final_progress.tolist()} for each in comparison.evaluations]
    arrays = {"is_success": None if is_success is None else is_success.tolist(), "evaluations": evaluations}
    return asdict(comparison) | arrays
