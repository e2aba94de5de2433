# SPDX-License-Identifier: MIT
"""A Triton request: its questions, and their answers or the error."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from rfm_client.contract import (
    InferenceFailedError,
    InvalidSampleError,
    PreferenceSample,
    ProgressSample,
    RewardError,
    SimilaritySample,
    wire,
)
from rfm_client.contract.process import about
from rfm_client.contract.samples import EncoderSample
from rfm_client.contract.wire import PROBE_PREFIX

Question = TypeVar("Question")
logger = logging.getLogger(__name__)

OUTCOMES = SCORED, REFUSED, FAILED, CANCELLED = "scored", "refused", "failed", "cancelled"

SAMPLE_TYPES = {
    ProgressSample: "progress",
    PreferenceSample: "preference",
    SimilaritySample: "similarity",
    EncoderSample: "encode",
}
UNKNOWN_TYPE = "unknown"  # sample type for a request that could not be decoded


class CancelledError(RewardError):
    """The client cancelled the request."""


@dataclass(eq=False)
class Request(Generic[Question]):
    """A Triton request and its state.

    request_id: the client's request id; may be empty
    outputs: names of the requested outputs
    is_cancelled: asks Triton if the client cancelled; takes 0.1 ms
    is_counted: False for warm-ups and probes, which metrics leave out
    sender: Triton's response sender; None: ``execute`` returns the response
    num_tokens: total token count; 0 before the samples are prepared
    questions, prepared, answers: of equal length, or still empty
    error: why there is no answer; None: answered, or not yet scored
    """

    request_id: str
    outputs: Collection[str]
    is_cancelled: Callable[[], bool]
    is_counted: bool
    sender: Any = None
    tensors: wire.Tensors = field(default_factory=dict)
    num_samples: int = 1
    num_tokens: int = 0
    questions: Sequence[Question] = ()
    prepared: Sequence[Any] = ()
    answers: Sequence[Any] = ()
    error: Exception | None = None

    @classmethod
    def of(cls, inference: Any) -> Request[Question]:
        """Return the request for Triton's ``inference``. Its tensors are views of Triton's memory."""
        request_id = inference.request_id()
        is_counted = not request_id.startswith(PROBE_PREFIX)
        request = cls(request_id, inference.requested_output_names(), inference.is_cancelled, is_counted)
        try:
            request.tensors = {tensor.name(): tensor.as_numpy() for tensor in inference.inputs()}
            lengths = request.tensors[wire.NUM_FRAMES]
            request.num_samples = len(lengths) if lengths.ndim > 1 else 0  # Triton 2.51 drops a batch axis of 0
            if not request.num_samples:
                request.error = InvalidSampleError.at(wire.NUM_FRAMES, "a batch of at least 1 sample", "0 samples")
        except Exception as error:  # noqa: BLE001  fails this request alone
            request.fail(error)
        return request

    def outlive(self, inference: Any) -> None:
        """Copy the tensors and take a response sender, so that a response can follow after ``execute``."""
        self.sender = inference.get_response_sender()
        self.is_cancelled = self.sender.is_cancelled
        try:
            self.tensors = {name: array.copy() for name, array in self.tensors.items()}
        except MemoryError as error:
            self.fail(error)

    def fail(self, cause: Exception) -> None:
        """Set an error without details; the cause goes to the log."""
        self.error = InferenceFailedError("scoring failed; the server's log has the reason")
        self.error.__cause__ = cause

    def log_error(self) -> None:
        """Log the error.

        Failures are logged as errors. Refused and cancelled requests are logged at DEBUG, so that clients cannot fill
        the log.
        """
        assert self.error is not None
        level = logging.ERROR if self.outcome == FAILED else logging.DEBUG
        sample_types = ",".join(sorted(self.sample_types))
        with about([self.request_id]):
            logger.log(level, "%s (%s): %s", self.outcome, sample_types, self.error, exc_info=self.error.__cause__)

    def response(self, outputs: wire.Tensors) -> Any:
        """Return Triton's response with these tensors."""
        import triton_python_backend_utils as pb_utils

        return pb_utils.InferenceResponse([pb_utils.Tensor(name, array) for name, array in outputs.items()])

    def error_response(self) -> Any:
        """Return Triton's response with the error."""
        import triton_python_backend_utils as pb_utils

        kinds = pb_utils.TritonError
        codes = {REFUSED: kinds.INVALID_ARG, CANCELLED: kinds.CANCELLED, FAILED: kinds.INTERNAL}
        return pb_utils.InferenceResponse(error=kinds(str(self.error), codes[self.outcome]))

    def send(self, response: Any) -> None:
        """Send this request's only response."""
        import triton_python_backend_utils as pb_utils

        self.sender.send(response, flags=pb_utils.TRITONSERVER_RESPONSE_COMPLETE_FINAL)

    @property
    def sample_types(self) -> Counter[str]:
        """Sample count per type."""
        if not self.questions:
            return Counter({UNKNOWN_TYPE: self.num_samples})
        return Counter(SAMPLE_TYPES[type(question)] for question in self.questions)

    @property
    def num_frames(self) -> int:
        """Total frame count over all trajectories."""
        return sum(trajectory.num_frames for question in self.questions for trajectory in question.trajectories)  # type: ignore[attr-defined]  # all questions have trajectories

    @property
    def outcome(self) -> str:
        """The request's outcome, one of OUTCOMES."""
        if self.error is None:
            return SCORED
        if isinstance(self.error, CancelledError):
            return CANCELLED
        return REFUSED if isinstance(self.error, InvalidSampleError) else FAILED
