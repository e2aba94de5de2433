# SPDX-License-Identifier: MIT
"""``rfm-client compare``: rank videos by how well they do a task."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

from rfm_client.cli.options import VideoOptions
from rfm_client.cli.scoring import COMPARE_LOG_PROB, Source, checkpoint_name, report_warnings
from rfm_client.cli.show import at_end, number, table, title_at_end, wrapped
from rfm_client.client import RewardClient
from rfm_client.contract.description import ModelInfo
from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.ranking import Ranking
from rfm_client.contract.results import PreferenceResult, ProgressResult, one_version
from rfm_client.contract.samples import PreferenceSample, ProgressSample, Trajectory
from rfm_client.frames.fit_to_checkpoint import fitted, with_frame_indices

LEGEND = (
    "  no answer: the orders disagree, or both are exactly 0.5.\n"
    "  No rank (?): one of the video's pairs has no answer, or another wins as often."
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Comparison(Ranking):
    """N sources, their scores, and their preferences from one model version.

    scores: for each source alone, as from ``score``; in a preference they depend on the other source
    """

    info: ModelInfo
    sources: Sequence[Source]
    scores: Sequence[ProgressResult]

    def tables(self) -> list[str]:
        """Return tables of sources, best first, and of pairs, the checkpoint, and without a ranking a legend."""
        best_first = sorted(self.numbers, key=self.wins.__getitem__, reverse=True)
        columns = ("video", "#", "rank", "P(wins)", title_at_end(self.scores[0]), "final success", "frames")
        pairs = ("first", "second", "P(first wins)", "order swapped", "mean", "orders")
        return [
            table("", columns, [self._row(index) for index in best_first]),
            table("", pairs, [self._pair_row(*couple) for couple in self.couples()]),
            wrapped(f"{checkpoint_name(self.info)} compared each video with every other.", "  ", "  "),
            *([LEGEND] if self.ranking is None else []),
        ]

    def _row(self, index: int) -> tuple[str, ...]:
        scores = self.scores[index]
        figures = (number(self.wins[index]), at_end(scores), number(scores.success[-1]))
        rank = str(self.ranks[index] or "?")
        return (self.sources[index].name, str(index + 1), rank, *figures, str(len(scores.progress)))

    def _pair_row(self, first: int, second: int) -> tuple[str, ...]:
        pair = self.pair(first, second)
        orders = "agree" if pair.verdict else "no answer"
        return (str(first + 1), str(second + 1), *map(number, (*(pair.both_orders or ()), pair.preference)), orders)


def compare(client: RewardClient, names: Sequence[str], video: VideoOptions) -> Comparison:
    """Compare every two sources on the first one's task. Raises RewardError."""
    sources = [Source.read(name, video) for name in names]
    trajectories = [_of_one_task(sources[0], source) for source in sources]
    info = client.model_info(frames=trajectories[0].frames is not None)
    if not info.has_preference:
        number_at_end = "final progress" if info.has_progress else "remaining seconds at the last frame"
        remedy = COMPARE_LOG_PROB if info.needs_whole_episode else f"compare {number_at_end} with rfm-client score"
        raise InvalidSampleError.at("compare", "a checkpoint with a preference head", checkpoint_name(info), remedy)
    limits = info.max_frames if video.subsample else None, info.frame_size if video.resize else None
    fits = [fitted(ProgressSample(trajectory), *limits) for trajectory in trajectories]  # once, not for every pair
    sent = [fit.sample.trajectories[0] for fit in fits]
    orders = list(itertools.permutations(range(len(sources)), 2))
    answers = client.evaluate([PreferenceSample(sent[first], sent[second]) for first, second in orders])
    alone = client.evaluate([fit.sample for fit in fits])
    scores = [
        cast(ProgressResult, with_frame_indices(each, fit.frame_indices)) for each, fit in zip(alone, fits, strict=True)
    ]
    one_version((*scores, *answers), "all videos")
    report_warnings([info])
    results = dict(zip(orders, cast("list[PreferenceResult]", answers), strict=True))
    return Comparison(info=info, sources=sources, scores=scores, results=results)


def _of_one_task(first: Source, other: Source) -> Trajectory:
    """Return the other's trajectory with the first's task, so that both orders share a task."""
    if other is first:
        return first.trajectory
    try:
        PreferenceSample(first.trajectory, other.trajectory)
    except InvalidSampleError as error:
        raise InvalidSampleError(f"{first.name} and {other.name}: {error}") from error
    asked = first.trajectory
    return replace(other.trajectory, task=asked.task, text_embedding=asked.text_embedding)
