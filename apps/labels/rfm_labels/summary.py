# SPDX-License-Identifier: MIT
"""Summarise a label file. Needs pyarrow. E episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client import Float32Array
from rfm_client.episodes import SuccessRule
from rfm_labels.datasets.faults import named, require
from rfm_labels.label_files import read_label_table, read_names
from rfm_labels.metadata import PROGRESS, SUCCESS, values_of

BACKWARDS_BY = 0.01  # kappa in reward-aligned behaviour cloning; a smaller fall is noise
VOTING_FRAMES = 3  # at an episode's end: a single frame may be an accident
_MOST_LISTED = 12


@dataclass(frozen=True, eq=False)
class Summary:
    """Scores per episode.

    episodes: int64 [E], episode numbers
    final_progress: float32 [E], at the last frame
    best_success: float32 [E], highest success; None: the checkpoint does not predict success
    last_success: float32 [E], success at the last frame; None as ``best_success``
    voted_success: float32 [E], as ``voted_success`` returns it; None as ``best_success``
    backwards: float64 [E], share of steps on which progress falls by more than 0.01
    disagreement: float64 [E], range of progress over cameras, averaged over frames; None: no separate camera scores
    num_frames: total over all episodes
    names: by number, of episodes that have names of their own
    """

    episodes: npt.NDArray[np.int64]
    final_progress: npt.NDArray[np.float32]
    best_success: npt.NDArray[np.float32] | None
    last_success: npt.NDArray[np.float32] | None
    voted_success: npt.NDArray[np.float32] | None
    backwards: npt.NDArray[np.float64]
    disagreement: npt.NDArray[np.float64] | None
    num_frames: int
    names: Mapping[int, str] = field(default_factory=dict)

    @property
    def outcomes(self) -> dict[str, npt.NDArray[np.bool_]]:
        """bool [E] by outcome name; empty if success is not predicted.

        An episode succeeds if most of its last three frames have a success of 0.5 or more.
        """
        if self.best_success is None or self.voted_success is None:
            return {}
        succeeds, ever = (each >= SuccessRule.threshold for each in (self.voted_success, self.best_success))
        return {"succeed": succeeds, "succeed, then undo it": ever & ~succeeds, "never succeed": ~ever}

    def rows(self) -> list[tuple[str, str]]:
        """Return names and values for a table."""
        quantiles = np.quantile(self.final_progress, [0, 0.25, 0.5, 0.75, 1])
        names = ("lowest", "lower quarter", "median", "upper quarter", "highest")
        by_outcome = {}
        for outcome, has_it in self.outcomes.items():
            numbers = self.episodes[has_it].tolist()
            more = " ..." if len(numbers) > _MOST_LISTED else ""
            listed = ", ".join(named(number, self.names.get(number)) for number in numbers[:_MOST_LISTED])
            by_outcome[outcome] = f"{len(numbers)}{': ' * bool(numbers)}{listed}{more}"
        return [
            ("episodes", str(len(self.episodes))),
            ("frames", str(self.num_frames)),
            *((f"final progress: {name}", f"{value:.4f}") for name, value in zip(names, quantiles, strict=True)),
            *((f"episodes that {outcome}", numbers) for outcome, numbers in (by_outcome or {"succeed": "-"}).items()),
            ("steps on which progress falls", f"{self.backwards.mean():.1%}"),
        ]


def voted_success(success: Float32Array) -> float:
    """Return the success, [T], that most of the last three frames reach: an episode succeeds at thresholds up to it."""
    voters = np.sort(success[-VOTING_FRAMES:])
    return float(voters[(len(voters) - 1) // 2])


def summarise(file: Path) -> Summary:
    """Summarise a label file. Raises DatasetError if it is not one."""
    table = read_label_table(file)
    require(file, len(table) > 0, "labels", "none")
    return summary_of(table, read_names(file))


def summary_of(labels: Any, names: Mapping[int, str]) -> Summary:
    """Summarise labels, a pyarrow Table with the parts' column names. names: as in ``Summary``"""
    episodes = values_of(labels["episode_index"])
    starts = np.flatnonzero(np.diff(episodes, prepend=episodes[0] - 1)).tolist()
    numbers, final, best, last, voted, backwards, apart = [], [], [], [], [], [], []
    for start, end in zip(starts, [*starts[1:], len(labels)], strict=True):
        table = labels.slice(start, end - start)
        progress = values_of(table[PROGRESS])
        is_scored = np.isfinite(progress)  # NaN: the model did not answer
        final.append(progress[-1])
        progress = progress[is_scored]
        cameras = [values_of(table[name])[is_scored] for name in table.column_names if name.startswith(f"{PROGRESS}.")]
        numbers.append(episodes[start])
        backwards.append(np.mean(np.diff(progress) < -BACKWARDS_BY) if len(progress) > 1 else 0.0)
        if SUCCESS in table.column_names:
            success = values_of(table[SUCCESS])
            best.append(success.max())
            last.append(success[-1])
            voted.append(voted_success(success))
        if cameras:
            apart.append(np.ptp(np.stack(cameras), axis=0).mean(dtype=np.float64))
    return Summary(
        episodes=np.array(numbers, np.int64),
        final_progress=np.array(final, np.float32),
        best_success=np.array(best, np.float32) if best else None,
        last_success=np.array(last, np.float32) if last else None,
        voted_success=np.array(voted, np.float32) if voted else None,
        backwards=np.array(backwards, np.float64),
        disagreement=np.array(apart, np.float64) if apart else None,
        num_frames=len(labels),
        names=names,
    )
