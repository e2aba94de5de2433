# SPDX-License-Identifier: MIT
"""One request: who sent it, what it asks and what became of it."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Generic, TypeVar

from rfm.journal import NO_DIGEST
from rfm.triton_model.request_digest import digest
from rfm_client.contract import (
    InferenceFailedError,
    InvalidSampleError,
    PreferenceSample,
    ProgressSample,
    RewardError,
    SimilaritySample,
    wire,
)
from rfm_client.contract.named_frames import NamedFootage, NamedProgressSample
from rfm_client.contract.names import PROBE_PREFIX
from rfm_client.contract.samples import Footage

Question = TypeVar("Question")

SCORED, REFUSED, FAILED = "scored", "refused", "failed"  # what becomes of a request
CANCELLED, REJECTED = "cancelled", "rejected"  # by the client; by the server, which takes no more
OUTCOMES = (SCORED, REFUSED, FAILED, CANCELLED, REJECTED)

SAMPLE_TYPES = {
    ProgressSample: "progress",
    NamedProgressSample: "progress",
    PreferenceSample: "preference",
    SimilaritySample: "similarity",
    Footage: "encode",
    NamedFootage: "encode",
}
US_PER_S = 1e6
WORTH_CHECKING_S = 10e-3  # for one answer: to ask Triton's process takes 0.1 ms a request
UNKNOWN_TYPE = "unknown"  # of the samples of a request that could not be decoded


class Origin(Enum):
    """Who sent a request. Metrics count callers' requests alone, and no other can be quarantined."""

    CALLER = "a caller"
    WARM_UP = "Triton, before it lets callers in"
    PROBE = "a health probe"


class CancelledError(RewardError):
    """The client has cancelled the request: nobody waits for its answer."""


class RejectedError(RewardError):
    """The model takes no more: it has no room for the request, no time before the request's ran out, or is ending."""


@dataclass(eq=False)
class Request(Generic[Question]):
    """A request of Triton's, and what came of it so far.

    request_id: the id that the client chose; empty if it chose none
    outputs: names of the outputs that the client wants
    is_cancelled: asks Triton whether the client has cancelled
    sender: Triton's, which takes the response; None: ``execute`` gives it back
    arrived_s: by time.monotonic, when the model got it
    waited_s: seconds from then until its turn
    patience_s: seconds that it may wait for its turn; None: any time
    num_samples: known when its tensors are read
    num_tokens: of all its samples, known when they are prepared
    digest: names its inputs in the quarantine
    questions: none unless it could be decoded
    prepared: one a question, once they are there
    answers: one a question, once they are there
    error: why it has no answer; None: it has one, or may get one
    """

    request_id: str
    outputs: Collection[str]
    is_cancelled: Callable[[], bool]
    sender: Any = None
    arrived_s: float = field(default_factory=time.monotonic)
    waited_s: float = 0.0
    patience_s: float | None = None
    origin: Origin = Origin.CALLER
    tensors: wire.Tensors = field(default_factory=dict)
    num_samples: int = 1
    num_tokens: int = 0
    digest: bytes = NO_DIGEST
    questions: Sequence[Question] = ()
    prepared: Sequence[Any] = ()
    answers: Sequence[Any] = ()
    error: Exception | None = None

    @classmethod
    def of(cls, inference: Any) -> Request[Question]:
        """What Triton hands over as ``inference``, without its tensors."""
        request = cls(inference.request_id(), inference.requested_output_names(), inference.is_cancelled)
        if timeout_us := inference.timeout():
            request.patience_s = timeout_us / US_PER_S
        return request

    def receive(self, inference: Any) -> None:
        """Takes the tensors, which are views of Triton's memory."""
        self.tensors = {tensor.name(): tensor.as_numpy() for tensor in inference.inputs()}
        self.num_samples = len(self.tensors[wire.NUM_FRAMES])

    def outlive(self, inference: Any) -> None:
        """Makes it a request that is answered after ``execute``, when Triton's memory of its tensors may be gone."""
        self.sender = inference.get_response_sender()
        self.is_cancelled = self.sender.is_cancelled
        try:
            self.tensors = {name: array.copy() for name, array in self.tensors.items()}
        except MemoryError as error:
            self.fail(error)

    def begin(self) -> None:
        """Notes that its turn has come."""
        self.waited_s = time.monotonic() - self.arrived_s

    def given_up(self, answer_s: float) -> CancelledError | None:
        """The error of a request that its client has cancelled; else None.

        Triton is only asked where an answer, which takes ``answer_s``, is worth a question.
        """
        if answer_s < WORTH_CHECKING_S or not self.is_cancelled():
            return None
        return CancelledError("cancelled by the client")

    def out_of_patience(self, patience_s: float | None) -> RejectedError | None:
        """The error of a request that had waited for longer than ``patience_s``, or than itself said; else None."""
        if not self.may_be_rejected:
            return None
        own_s = math.inf if self.patience_s is None else self.patience_s
        least_s = min(own_s, math.inf if patience_s is None else patience_s)
        if self.waited_s <= least_s:
            return None
        of_whom = "queue_timeout_ms" if least_s == patience_s else "its own timeout"
        return RejectedError(f"the request has waited for longer than {least_s:g} s ({of_whom})")

    def fail(self, cause: Exception) -> None:
        """Notes that something went wrong of which clients need not know more."""
        self.error = InferenceFailedError("scoring failed; the server's log has the reason")
        self.error.__cause__ = cause

    def response(self, outputs: wire.Tensors) -> Any:
        """Triton's response of these tensors."""
        import triton_python_backend_utils as pb_utils

        return pb_utils.InferenceResponse([pb_utils.Tensor(name, array) for name, array in outputs.items()])

    def error_response(self) -> Any:
        """Triton's response of the error, of which the log knows more than the client."""
        import triton_python_backend_utils as pb_utils

        codes = {
            InvalidSampleError: pb_utils.TritonError.INVALID_ARG,
            CancelledError: pb_utils.TritonError.CANCELLED,
            RejectedError: pb_utils.TritonError.UNAVAILABLE,
        }
        code = next((codes[kind] for kind in codes if isinstance(self.error, kind)), pb_utils.TritonError.INTERNAL)
        return pb_utils.InferenceResponse(error=pb_utils.TritonError(str(self.error), code))

    def send(self, response: Any) -> None:
        """Sends the response, which is the only one to this request."""
        import triton_python_backend_utils as pb_utils

        self.sender.send(response, flags=pb_utils.TRITONSERVER_RESPONSE_COMPLETE_FINAL)

    @property
    def num_bytes(self) -> int:
        """Bytes of its tensors."""
        return sum(array.nbytes for array in self.tensors.values())

    @property
    def is_counted(self) -> bool:
        """Whether the metrics count this request: a caller sent it."""
        return self.origin is Origin.CALLER

    @property
    def may_be_rejected(self) -> bool:
        """Whether there may be no room for it. A probe always finds some: a busy model is a healthy one."""
        return self.is_counted

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
        if isinstance(self.error, RejectedError):
            return REJECTED
        return REFUSED if isinstance(self.error, InvalidSampleError) else FAILED


class Origins:
    """Finds out who sent a request.

    num_warmups: requests with which Triton warms the instance up, before anybody else is let in
    blank: digest of the inputs of a health probe
    """

    def __init__(self, num_warmups: int, blank: bytes) -> None:
        self._num_warmups = num_warmups
        self._blank = blank

    def find(self, request: Request[Any]) -> None:
        """Notes who sent the request, and its digest if it is a caller's.

        The first without an id are warm-ups. Anybody can say to be a probe, which asks the blank question.
        """
        if self._num_warmups and not request.request_id:
            self._num_warmups -= 1
            request.origin = Origin.WARM_UP
            return
        of_tensors = digest(request.tensors)
        if request.request_id.startswith(PROBE_PREFIX) and of_tensors == self._blank:
            request.origin = Origin.PROBE
        else:
            request.digest = of_tensors


def _num_frames(question: Any) -> int:
    return sum(trajectory.num_frames for trajectory in question.trajectories)
