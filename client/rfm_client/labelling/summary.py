# SPDX-License-Identifier: MIT
"""What a file of labels says of its episodes at a glance. Needs pyarrow. E episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rfm_client.contract.results import SUCCESS_THRESHOLD
from rfm_client.contract.samples import Float32Array
from rfm_client.data.datasets.protocol import DatasetError
from rfm_client.labelling.episode_scores import PROGRESS, SUCCESS
from rfm_client.labelling.parts import Parts
from rfm_client.labelling.plan import Plan

_PROGRESS = ("progress_sparse", "progress")
BACKWARDS_BY = 0.01  # the kappa of reward-aligned behaviour cloning: less is noise


@dataclass(frozen=True, eq=False)
class Summary:
    """Scores of each episode.

    episodes: int64 [E], their numbers
    final_progress: float32 [E]
    best_success: float32 [E], the highest of each; None: the checkpoint does not predict success
    backwards: float64 [E], share of steps on which progress falls by more than 0.01
    num_frames: of all episodes
    """

    episodes: npt.NDArray[np.int64]
    final_progress: npt.NDArray[np.float32]
    best_success: npt.NDArray[np.float32] | None
    backwards: npt.NDArray[np.float64]
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
    from pyarrow import ArrowException, parquet

    try:
        names = parquet.read_schema(file).names
        progress, success = _columns(file, names)
        table = parquet.read_table(file, columns=["episode_index", progress, *([success] if success else [])])
    except (OSError, ArrowException) as error:
        raise DatasetError.at(file, "a file of labels", str(error)) from error
    episodes = table["episode_index"].to_numpy()
    starts = np.flatnonzero(np.diff(episodes, prepend=episodes[0] - 1))
    values = np.split(table[progress].to_numpy(), starts[1:])
    successes = np.split(table[success].to_numpy(), starts[1:]) if success else None
    return _summary(episodes[starts].tolist(), values, successes)


def summary_of_parts(plan: Plan, parts: Parts) -> Summary:
    """The summary of the parts of a plan."""
    rows = []
    for item in plan.items:
        table = parts.read(item)
        success = table[SUCCESS].to_numpy() if SUCCESS in table.column_names else None
        rows.append(
            _summary([item.episode.index], [table[PROGRESS].to_numpy()], None if success is None else [success])
        )
    return Summary(
        episodes=np.concatenate([row.episodes for row in rows]),
        final_progress=np.concatenate([row.final_progress for row in rows]),
        best_success=None
        if rows[0].best_success is None
        else np.concatenate([row.best_success for row in rows if row.best_success is not None]),
        backwards=np.concatenate([row.backwards for row in rows]),
        num_frames=sum(row.num_frames for row in rows),
    )


def _summary(
    episodes: Sequence[int], progress: Sequence[Float32Array], success: Sequence[Float32Array] | None
) -> Summary:
    return Summary(
        episodes=np.array(episodes, np.int64),
        final_progress=np.array([each[-1] for each in progress]),
        best_success=None if success is None else np.array([each.max() for each in success]),
        backwards=np.array([np.mean(np.diff(each) < -BACKWARDS_BY) if len(each) > 1 else 0.0 for each in progress]),
        num_frames=sum(map(len, progress)),
    )


def _columns(file: Path, names: Sequence[str]) -> tuple[str, str | None]:
    """Names of the fused progress and success in either form of file."""
    for name in _PROGRESS:
        if name in names:
            return name, "success" if "success" in names else None
    for name in names:
        if name.startswith("reward.") and name.endswith(".progress"):
            success = name.removesuffix("progress") + "success_probability"
            return name, success if success in names else None
    raise DatasetError.at(file, "a column of progress", ", ".join(names))


def _listed(numbers: Sequence[int], most: int = 12) -> str:
    shown = ", ".join(map(str, numbers[:most]))
    return shown + (" ..." if len(numbers) > most else "")
