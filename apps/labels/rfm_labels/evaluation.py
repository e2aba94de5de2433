# SPDX-License-Identifier: MIT
"""Compare label files to see which reward model suits a dataset. Needs pyarrow. E episodes, T frames.

Value-order correlation (VOC) is the rank correlation between progress and time over a successful episode, as in GVL (Ma
et al., 2024) and Robometer's evaluation. A high VOC shows that progress rises, not that its values are right: a clock's
VOC is 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client.options import first_names
from rfm_labels.datasets.faults import DatasetError, named, require
from rfm_labels.label_files import LabelFile, read_label_table, read_names, reward_name
from rfm_labels.metadata import PROGRESS, SUCCESS
from rfm_labels.summary import BACKWARDS_BY, voted_success

Floats = npt.NDArray[np.floating[Any]]

_ROUNDING = 1e-12  # tolerance when comparing balanced accuracies
FEW = 10  # 95 % of draws of 10 successes and 10 failures measure a true AUROC of 0.8 within 0.22


@dataclass(frozen=True, eq=False)
class Ranking:
    """How well a single number per episode separates successes from failures.

    auroc: probability that a success has the higher number; ties count half; 0.5 is chance
    threshold: for "success if at least this", the lowest with the best balanced accuracy: halfway between two
        neighbouring numbers, with the fewest decimals, 4 or more, that still separate them
    balanced_accuracy: mean of sensitivity and specificity at the threshold
    """

    auroc: float
    threshold: float
    balanced_accuracy: float


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Metrics for one label file. Means are over episodes.

    name: file name without its ending
    spearman, kendall: mean VOC as Spearman's rho and Kendall's tau-b, over known successes, or over all episodes if
        outcomes are unknown; None: progress is constant in every episode
    num_constant: episodes with constant progress, which have no VOC
    by_success, by_progress: how well ``voted_success`` and final progress separate successes from failures; None:
        outcomes are unknown or all alike, or the model does not predict success
    final_of_successes, final_of_failures: mean progress at the last frame; None: no such episode
    final: mean progress at the last frame, over all episodes
    backwards: mean share of steps on which progress falls by more than 0.01
    final_progress: float64 [E], progress at the last frame
    warning: as in ``rfm_client.ModelInfo``, about the checkpoint of the labels
    """

    name: str
    num_episodes: int
    num_frames: int
    spearman: float | None
    kendall: float | None
    num_constant: int
    by_success: Ranking | None
    by_progress: Ranking | None
    final_of_successes: float | None
    final_of_failures: float | None
    final: float
    backwards: float
    final_progress: Floats
    warning: str | None


@dataclass(frozen=True, eq=False)
class LabelComparison:
    """Evaluations of several label files, on the episodes that all of them share.

    episodes: numbers of the shared episodes
    is_success: bool [E]; None: outcomes are unknown
    num_left_out: episodes that only some files have
    lacking: names of the files that lack some of these episodes
    num_without_outcome: shared episodes left out because their outcome is unknown
    without_labels: episodes with an outcome that no file has, by number or name
    """

    evaluations: Sequence[Evaluation]
    episodes: Sequence[int]
    is_success: npt.NDArray[np.bool_] | None
    num_left_out: int
    num_without_outcome: int
    without_labels: Sequence[int | str] = ()
    lacking: Sequence[str] = ()

    @property
    def notes(self) -> list[str]:
        """What everyone who sees these numbers must know, one line each."""
        by_warning: dict[str, list[str]] = {}
        for each in self.evaluations:
            if each.warning:
                by_warning.setdefault(each.warning, []).append(each.name)
        notes = [f"{', '.join(names)}: {warning}" for warning, names in by_warning.items()]
        known = self.is_success
        if known is not None and min(known.sum(), (~known).sum()) < FEW:
            notes.append(f"fewer than {FEW} successes or failures: AUROC may be off by 0.2 or more (take 20 of each)")
        return notes


@dataclass(frozen=True, eq=False)
class _Scores:
    """An episode's labelled frames. success: None: not predicted."""

    progress: Floats
    success: Floats | None


def evaluate_labels(files: Sequence[Path], outcomes: Mapping[Any, bool | None] | None = None) -> LabelComparison:
    """Return an evaluation of label files for one dataset.

    outcomes: as ``read_outcomes`` returns them: True for success; None, or no entry, to leave the episode out; None:
        unknown

    Raises DatasetError if a file is unreadable, the files share no episode or name one differently, or no episode has
    an outcome.
    """
    require("labels", len(files) > 0, "at least one file", "none")
    names = _names(files)
    read = {name: _episodes(file) for name, file in zip(names, files, strict=True)}
    own = read_names(*files)
    common = sorted(set.intersection(*(set(episodes) for episodes in read.values())))
    everywhere = set.union(*(set(episodes) for episodes in read.values()))
    require("labels", len(common) > 0, "an episode that all files have", "none")
    in_all = len(common)
    without_labels = [episode for episode in outcomes or () if episode not in everywhere]
    if outcomes is not None:
        known = [episode for episode in common if outcomes.get(episode) is not None]
        if not known:
            got = f"none for {in_all} episodes: {first_names([named(each, own.get(each)) for each in common])}"
            got += f"; no labels for {first_names(without_labels)}" if without_labels else ""
            raise DatasetError.at("outcome", "one that is known", got)
        common = known
    is_success = None if outcomes is None else np.array([outcomes[episode] for episode in common])
    evaluations = [
        _evaluation(name, [read[name][each] for each in common], is_success, LabelFile.read(file).warning)
        for name, file in zip(names, files, strict=True)
    ]
    left_out = len(everywhere) - in_all, in_all - len(common)
    lacking = [name for name, episodes in read.items() if len(episodes) < len(everywhere)]
    return LabelComparison(evaluations, common, is_success, *left_out, without_labels, lacking)


def _names(files: Sequence[Path]) -> list[str]:
    """Return a name for each file: the reward's name, or the path if two rewards share a name."""
    short = [reward_name(file) for file in files]
    names = [name if short.count(name) == 1 else str(file) for name, file in zip(short, files, strict=True)]
    require("labels", len(set(names)) == len(names), "each file once", ", ".join(names))
    return names


def _episodes(file: Path) -> dict[int, _Scores]:
    table = read_label_table(file)
    require(file, len(table) > 0, "labels", "none")
    progress = table[PROGRESS].to_numpy()
    success = table[SUCCESS].to_numpy() if SUCCESS in table.column_names else None
    scores = {}
    numbers, starts = np.unique(table["episode_index"].to_numpy(), return_index=True)
    for episode, own in zip(numbers.tolist(), np.split(np.arange(len(table)), starts[1:]), strict=True):
        rows = own[np.isfinite(progress[own])]  # NaN: unlabelled frame
        require(f"{file}: episode {episode}", len(rows) > 0, "progress", "none")
        predicted = None if success is None or np.isnan(success[rows]).any() else success[rows]
        scores[episode] = _Scores(progress[rows], predicted)
    return scores


def _evaluation(
    name: str, scores: Sequence[_Scores], is_success: npt.NDArray[np.bool_] | None, warning: str | None
) -> Evaluation:
    final = np.array([each.progress[-1] for each in scores], np.float64)
    orders = [_order(each.progress) for index, each in enumerate(scores) if is_success is None or is_success[index]]
    known = [order for order in orders if order is not None]
    voted = np.array([voted_success(each.success) for each in scores if each.success is not None], np.float64)
    falls = [float((np.diff(each.progress) < -BACKWARDS_BY).sum()) / max(len(each.progress) - 1, 1) for each in scores]
    return Evaluation(
        name=name,
        num_episodes=len(scores),
        num_frames=sum(len(each.progress) for each in scores),
        spearman=_mean([rho for rho, _ in known]),
        kendall=_mean([tau for _, tau in known]),
        num_constant=len(orders) - len(known),
        by_success=_ranking(voted, is_success) if len(voted) == len(scores) else None,
        by_progress=_ranking(final, is_success),
        final_of_successes=None if is_success is None else _mean(final[is_success]),
        final_of_failures=None if is_success is None else _mean(final[~is_success]),
        final=float(final.mean()),
        backwards=float(np.mean(falls)),
        final_progress=final,
        warning=warning,
    )


def _order(progress: Floats) -> tuple[float, float] | None:
    """Return Spearman's rho and Kendall's tau-b between progress and time; None: progress is constant."""
    from scipy.stats import kendalltau, spearmanr

    time = np.arange(len(progress))
    if np.ptp(progress) == 0:
        return None
    return float(spearmanr(progress, time).statistic), float(kendalltau(progress, time).statistic)


def _ranking(numbers: Floats, is_success: npt.NDArray[np.bool_] | None) -> Ranking | None:
    if is_success is None or is_success.all() or not is_success.any():
        return None
    from sklearn.metrics import roc_auc_score, roc_curve

    false_positives, true_positives, thresholds = roc_curve(is_success, numbers, drop_intermediate=False)
    accuracies = (true_positives + 1 - false_positives) / 2
    best = np.flatnonzero(np.isclose(accuracies, accuracies.max(), rtol=0, atol=_ROUNDING))[-1]  # the lowest threshold
    threshold = _between(max(numbers[numbers < thresholds[best]], default=0.0), thresholds[best])
    return Ranking(float(roc_auc_score(is_success, numbers)), threshold, float(accuracies[best]))


def _between(below: float, least: float) -> float:
    """Return the middle with the fewest decimals, 4 or more, that stays above ``below``, in float32 too."""
    rounded = (round((below + least) / 2, decimals) for decimals in range(4, 17))
    return float(next((each for each in rounded if below < np.float32(each) and each <= least), least))


def _mean(numbers: Sequence[float] | Floats) -> float | None:
    return float(np.mean(numbers)) if len(numbers) else None
