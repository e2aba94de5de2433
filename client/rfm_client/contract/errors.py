# SPDX-License-Identifier: MIT
"""What can go wrong when asking for a reward.

    RewardError
    +-- InvalidSampleError        the sample is at fault; sending it again gives the same answer
    +-- ServerError               the server is at fault, or cannot be reached
        +-- ServerUnavailableError    no connection, not ready, or its queue is full
            +-- ProcessEndedError     a process, or the connection, has ended, perhaps because of this request
        +-- DeadlineExceededError     no answer within the time that the caller gave
        +-- ModelNotFoundError        the server does not serve a model of that name
        +-- AccessDeniedError         server and client do not trust each other: certificate, key, or TLS on one side
        +-- InferenceFailedError      the server tried and failed; its log has the reason

No error is ever replaced by a number.
"""

from __future__ import annotations


class RewardError(Exception):
    """Base of every error that this library raises.

    request_id: the id of the failed request in the server's log, at the end of the message; None: none was sent
    may_have_ended_server: a process of the model had ended, or the connection ended under the request, which may be
        why
    """

    request_id: str | None = None
    may_have_ended_server = False

    @property
    def message(self) -> str:
        """What is wrong, without the request's id."""
        return super().__str__()

    def __str__(self) -> str:
        return self.message if self.request_id is None else f"{self.message} (request {self.request_id})"


class InvalidSampleError(RewardError, ValueError):
    """A sample that cannot be scored, reported as ``where: expected X, got Y``."""

    @classmethod
    def at(cls, where: str, expected: str, got: str) -> InvalidSampleError:
        """The error at the field ``where``."""
        return cls(f"{where}: expected {expected}, got {got}")

    def inside(self, where: str) -> InvalidSampleError:
        """The same error, seen from the object that holds the field: ``where.field: ...``."""
        located = type(self)(f"{where}.{self.message}")
        located.request_id = self.request_id
        return located


class ServerError(RewardError):
    """The server did not answer as it should; the sample may be fine."""


class ServerUnavailableError(ServerError):
    """The server cannot be reached, is not ready, or refuses more work for now."""


class ProcessEndedError(ServerUnavailableError):
    """A process of the model had ended when the request reached it, or it or the connection ended under the request."""

    may_have_ended_server = True


class DeadlineExceededError(ServerError, TimeoutError):
    """No answer came within the caller's time limit."""


class ModelNotFoundError(ServerError):
    """The server does not serve the requested model."""


class AccessDeniedError(ServerError):
    """One side refuses the other: a certificate or key is missing or another, or only one of them speaks TLS."""


class InferenceFailedError(ServerError):
    """The server failed while scoring; its log names the reason."""
