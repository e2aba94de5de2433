# SPDX-License-Identifier: MIT
"""One request of a batch: what is known of it, for whoever answers, counts and logs it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from rfm_client.contract import (
    InvalidSampleError,
    PreferenceSample,
    ProgressSample,
    RewardError,
    SimilaritySample,
)
from rfm_client.contract.samples import Footage
from rfm_client.contract.wire import Tensors

Question = TypeVar("Question")

SCORED, REFUSED, FAILED, CANCELLED = "scored", "refused", "failed", "cancelled"  # what becomes of a request
OUTCOMES = (SCORED, REFUSED, FAILED, CANCELLED)

SAMPLE_TYPES = {
    ProgressSample: "progress",
    PreferenceSample: "preference",
    SimilaritySample: "similarity",
    Footage: "encode",
}
UNKNOWN_TYPE = "unknown"  # of the samples of a request that could not be decoded


class CancelledError(RewardError):
    """The client has cancelled the request: nobody waits for its answer."""


@dataclass(eq=False)
class Asked(Generic[Question]):
    """A request, and what came of it so far.

    is_counted: whether metrics count it
    num_samples: known when its tensors are read
    questions: none unless it could be decoded
    num_executed: questions that were worked on
    error: why it has no answer; None: it has, or may have one
    """

    request: Any
    is_counted: bool
    tensors: Tensors = field(default_factory=dict)
    num_samples: int = 1
    questions: list[Question] = field(default_factory=list)
    num_executed: int = 0
    error: Exception | None = None

    @property
    def request_id(self) -> str:
        """As the client chose it; empty if it did not."""
        return str(self.request.request_id())

    @property
    def sample_types(self) -> Counter[str]:
        """How many samples of each type it asks about."""
        if not self.questions:
            return Counter({UNKNOWN_TYPE: self.num_samples})
        return Counter(SAMPLE_TYPES[type(question)] for question in self.questions)

    @property
    def num_frames(self) -> int:
        """Of all trajectories that it asks about."""
        return sum(_num_frames(question) for question in self.questions)

    @property
    def outcome(self) -> str:
        """One of OUTCOMES."""
        if self.error is None:
            return SCORED
        if isinstance(self.error, CancelledError):
            return CANCELLED
        return REFUSED if isinstance(self.error, InvalidSampleError) else FAILED


def _num_frames(question: Any) -> int:
    return sum(trajectory.num_frames for trajectory in question.trajectories)
