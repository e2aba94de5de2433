# SPDX-License-Identifier: MIT
"""``rfm-client compare``: which of two videos does a task better, asked in both orders.

A model's preference may depend on the order of the videos. If the orders disagree, there is no verdict.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

from rfm_client.cli.options import VideoOptions
from rfm_client.cli.scoring import Source
from rfm_client.cli.show import at_end, number, table
from rfm_client.client import RewardClient
from rfm_client.contract.errors import InferenceFailedError, InvalidSampleError
from rfm_client.contract.results import PreferenceResult, ProgressResult
from rfm_client.contract.samples import PreferenceSample, ProgressSample
from rfm_client.scoring.samples import CallOptions

NO_VERDICT = "No verdict: the orders disagree, or both are exactly 0.5."


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two sources, and what one model version says about them.

    scores: for each source alone, as from ``score``; in a preference they depend on the other source
    preference: from both orders
    """

    sources: Sequence[Source]
    scores: Sequence[ProgressResult]
    preference: PreferenceResult

    @property
    def wins(self) -> tuple[float, float]:
        """Each source's probability of winning, averaged over both orders."""
        return self.preference.preference, 1 - self.preference.preference

    def shown(self) -> str:
        """Return a table with a row for each source, and below it the verdict."""
        columns = ("video", "P(wins)", "final progress", "final success", "frames")
        rows = [
            (source.name, number(wins), at_end(scores), number(scores.success[-1]), str(len(scores.progress)))
            for source, scores, wins in zip(self.sources, self.scores, self.wins, strict=True)
        ]
        verdict = self.preference.verdict
        told = NO_VERDICT if verdict is None else f"The {verdict} video does the task better."
        asked, swapped = map(number, self.preference.both_orders or ())
        return f"{table('', columns, rows)}\nP(first wins) = {asked}, with the order swapped {swapped}.\n{told}"


def compare(client: RewardClient, names: Sequence[str], video: VideoOptions) -> Comparison:
    """Compare two sources on the first one's task. Raises RewardError."""
    sources = [Source.read(name, video) for name in names]
    first, second = (source.trajectory for source in sources)
    try:
        PreferenceSample(first, second)
    except InvalidSampleError as error:
        raise InvalidSampleError(f"{' and '.join(names)}: {error}") from error
    second = replace(second, task=first.task, text_embedding=first.text_embedding)
    options: CallOptions = {"subsample": video.subsample, "resize": video.resize}
    preference = client.preference(first, second, both_orders=True, **options)
    options["all_scores"] = True
    alone = client.evaluate([ProgressSample(first), ProgressSample(second)], **options)
    versions = sorted({str(result.model_version) for result in (preference, *alone)})
    if len(versions) > 1:
        raise InferenceFailedError(f"model_version: expected one for all videos, got {', '.join(versions)}: ask again")
    return Comparison(sources, cast("list[ProgressResult]", alone), preference)
