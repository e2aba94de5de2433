# SPDX-License-Identifier: MIT
"""One request of a batch: who sent it, what it asks and what became of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Generic, TypeVar

from rfm.journal import NO_DIGEST
from rfm.triton_model.request_digest import digest
from rfm_client.contract import (
    InvalidSampleError,
    PreferenceSample,
    ProgressSample,
    RewardError,
    SimilaritySample,
    wire,
)
from rfm_client.contract.names import PROBE_PREFIX
from rfm_client.contract.samples import Footage

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


class Origin(Enum):
    """Who sent a request. Metrics count callers' requests alone, and no other can be quarantined."""

    CALLER = "a caller"
    WARM_UP = "Triton, before it lets callers in"
    PROBE = "a health probe"


class CancelledError(RewardError):
    """The client has cancelled the request: nobody waits for its answer."""


@dataclass(eq=False)
class Request(Generic[Question]):
    """A request as Triton hands it over (``inference``), and what came of it so far.

    num_samples: known when its tensors are read
    digest: names its inputs in the quarantine
    questions: none unless it could be decoded
    answers: one a question, once they are there
    error: why it has no answer; None: it has one, or may get one
    """

    inference: Any
    origin: Origin = Origin.CALLER
    tensors: wire.Tensors = field(default_factory=dict)
    num_samples: int = 1
    digest: bytes = NO_DIGEST
    questions: Sequence[Question] = ()
    answers: Sequence[Any] = ()
    error: Exception | None = None

    def read(self, input_names: Iterable[str]) -> None:
        """Takes the tensors from Triton and forgets what came of an attempt before."""
        import triton_python_backend_utils as pb_utils

        self.questions, self.answers, self.error = (), (), None
        given = {name: pb_utils.get_input_tensor_by_name(self.inference, name) for name in input_names}
        self.tensors = {name: tensor.as_numpy() for name, tensor in given.items() if tensor is not None}
        self.num_samples = len(self.tensors[wire.NUM_FRAMES])

    @property
    def request_id(self) -> str:
        """The id that the client chose; empty if it chose none."""
        return str(self.inference.request_id())

    @property
    def is_counted(self) -> bool:
        """Whether the metrics count this request: a caller sent it."""
        return self.origin is Origin.CALLER

    @property
    def sample_types(self) -> Counter[str]:
        """How many samples of each type it asks about."""
        if not self.questions:
            return Counter({UNKNOWN_TYPE: self.num_samples})
        return Counter(SAMPLE_TYPES[type(question)] for question in self.questions)

    @property
    def num_frames(self) -> int:
        """Frames of all trajectories that it asks about."""
        return sum(_num_frames(question) for question in self.questions)

    @property
    def outcome(self) -> str:
        """How the request ended: one of OUTCOMES."""
        if self.error is None:
            return SCORED
        if isinstance(self.error, CancelledError):
            return CANCELLED
        return REFUSED if isinstance(self.error, InvalidSampleError) else FAILED


class Origins:
    """Finds out who sent a request.

    num_warmups: requests with which Triton warms the instance up, before anybody else is let in
    blank: digest of the inputs of a health probe
    """

    def __init__(self, num_warmups: int, blank: bytes) -> None:
        self._num_warmups = num_warmups
        self._blank = blank

    def mark(self, batch: Iterable[Request[Any]]) -> None:
        """Notes who the requests say that they are from; the first without an id are warm-ups."""
        for request in batch:
            if request.request_id.startswith(PROBE_PREFIX):
                request.origin = Origin.PROBE
            elif self._num_warmups and not request.request_id:
                self._num_warmups -= 1
                request.origin = Origin.WARM_UP

    def verify(self, request: Request[Any]) -> None:
        """Notes who sent a request whose tensors are read: anybody can say to be a probe, which asks the blank one."""
        if request.origin is Origin.PROBE and digest(request.tensors) != self._blank:
            request.origin = Origin.CALLER
        request.digest = digest(request.tensors) if request.is_counted else NO_DIGEST


def _num_frames(question: Any) -> int:
    return sum(trajectory.num_frames for trajectory in question.trajectories)
