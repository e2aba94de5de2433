# SPDX-License-Identifier: MIT
"""What a file of labels says of its episodes at a glance. Needs pyarrow. E episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client.contract.results import SUCCESS_THRESHOLD
from rfm_client.data.datasets.protocol import DatasetError
from rfm_client.labelling.finished_episodes import Parts
from rfm_client.labelling.label_files import LabelColumns, read_label_table
from rfm_client.labelling.plan import Plan

BACKWARDS_BY = 0.01  # the kappa of reward-aligned behaviour cloning: less is noise


@dataclass(frozen=True, eq=False)
class Summary:
    """Scores of each episode.

    episodes: int64 [E], their numbers
    final_progress: float32 [E]
    best_success: float32 [E], the highest of each; None: the checkpoint does not predict success
    backwards: float64 [E], share of steps on which progress falls by more than 0.01
    disagreement: float64 [E], how far the cameras' progress is apart, in the mean over its frames; None: there are no
    scores of several cameras
    num_frames: of all episodes
    """

    episodes: npt.NDArray[np.int64]
    final_progress: npt.NDArray[np.float32]
    best_success: npt.NDArray[np.float32] | None
    backwards: npt.NDArray[np.float64]
    disagreement: npt.NDArray[np.float64] | None
    num_frames: int

    @property
    def never_succeed(self) -> npt.NDArray[np.int64] | None:
        """Numbers of the episodes in which no frame has a success of 0.5 or more; None: success is not predicted."""
        return None if self.best_success is None else self.episodes[self.best_success < SUCCESS_THRESHOLD]

    def rows(self) -> list[tuple[str, str]]:
        """What a table tells, line by line."""
        quantiles = np.quantile(self.final_progress, [0, 0.25, 0.5, 0.75, 1])
        failing = self.never_succeed
        names = ("lowest", "lower quarter", "median", "upper quarter", "highest")
        return [
            ("episodes", str(len(self.episodes))),
            ("frames", str(self.num_frames)),
            *((f"final progress: {name}", f"{value:.4f}") for name, value in zip(names, quantiles, strict=True)),
            ("episodes that never succeed", "-" if failing is None else f"{len(failing)}: {_listed(failing.tolist())}"),
            ("steps on which progress falls", f"{self.backwards.mean():.1%}"),
        ]


def summarise(file: Path) -> Summary:
    """The summary of a progress file or a file of frame signals. Raises DatasetError for another file."""
    table, columns = read_label_table(file)
    if not len(table):
        raise DatasetError.at(file, "labels", "none")
    episodes = table["episode_index"].to_numpy()
    starts = np.flatnonzero(np.diff(episodes, prepend=episodes[0] - 1))
    return _joined(
        [
            _of_episode(int(episodes[start]), table.slice(start, end - start), columns)
            for start, end in zip(starts, [*starts[1:], len(table)], strict=True)
        ]
    )


def summary_of_parts(plan: Plan, parts: Parts) -> Summary:
    """The summary of the parts of a plan."""
    summaries = []
    for item in plan.items:
        table = parts.read(item)
        columns = LabelColumns.among(item.episode.name, table.column_names)
        summaries.append(_of_episode(item.episode.index, table, columns))
    return _joined(summaries)


def _of_episode(index: int, table: Any, columns: LabelColumns) -> Summary:
    progress = table[columns.progress].to_numpy()
    success = None if columns.success is None else table[columns.success].to_numpy()
    cameras = [table[name].to_numpy() for name in columns.progress_of.values()]
    return Summary(
        episodes=np.array([index], np.int64),
        final_progress=progress[-1:],
        best_success=None if success is None else success.max(keepdims=True),
        backwards=np.array([np.mean(np.diff(progress) < -BACKWARDS_BY) if len(progress) > 1 else 0.0]),
        disagreement=np.ptp(np.stack(cameras), axis=0).mean(dtype=np.float64, keepdims=True) if cameras else None,
        num_frames=len(progress),
    )


def _joined(summaries: Sequence[Summary]) -> Summary:
    """One summary of the episodes of several."""
    success = [each.best_success for each in summaries if each.best_success is not None]
    disagreement = [each.disagreement for each in summaries if each.disagreement is not None]
    return Summary(
        episodes=np.concatenate([each.episodes for each in summaries]),
        final_progress=np.concatenate([each.final_progress for each in summaries]),
        best_success=np.concatenate(success) if success else None,
        backwards=np.concatenate([each.backwards for each in summaries]),
        disagreement=np.concatenate(disagreement) if disagreement else None,
        num_frames=sum(each.num_frames for each in summaries),
    )


def _listed(numbers: Sequence[int], most: int = 12) -> str:
    shown = ", ".join(map(str, numbers[:most]))
    return shown + (" ..." if len(numbers) > most else "")
