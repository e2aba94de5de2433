# SPDX-License-Identifier: MIT
"""Errors of a call to the server.

    RewardError
    +-- InvalidSampleError        the sample is at fault; a retry gives the same answer
    +-- ClientClosedError         the client was closed before or during the call
    +-- ServerError               the server is at fault or unreachable
        +-- ServerUnavailableError    no connection, not ready, or a full queue
            +-- ProcessEndedError     a process or the connection ended, perhaps because of this request
        +-- DeadlineExceededError     no answer within the caller's time limit
        +-- ModelNotFoundError        the server does not serve this model
        +-- AccessDeniedError         client and server disagree on certificate, key or TLS
        +-- InferenceFailedError      the server failed (see its log), or its answer is invalid

An error never becomes a number.
"""

from __future__ import annotations


class RewardError(Exception):
    """Base of this library's own errors.

    request_id: id of the failed request in the server's log, appended to the message; None: no request was sent
    may_have_ended_server: True if a model process or the connection ended, perhaps because of the request
    """

    request_id: str | None = None
    may_have_ended_server = False

    @property
    def message(self) -> str:
        """Description of the error, without the request's id."""
        return super().__str__()

    def __str__(self) -> str:
        return self.message if self.request_id is None else f"{self.message} (request {self.request_id})"


class InvalidSampleError(RewardError, ValueError):
    """An invalid sample, reported as ``where: expected X, got Y``."""

    @classmethod
    def at(cls, where: str, expected: str, got: str) -> InvalidSampleError:
        """Return the error at the field ``where``."""
        return cls(f"{where}: expected {expected}, got {got}")

    def inside(self, where: str) -> InvalidSampleError:
        """Return the error with the name of the object around its field: ``where.field: ...``."""
        located = type(self)(f"{where}.{self.message}")
        located.request_id = self.request_id
        return located


class ClientClosedError(RewardError, RuntimeError):
    """A call of a client that was closed before it, or during it."""


class ServerError(RewardError):
    """A failure of the server or of the connection to it; the sample may be valid."""


class ServerUnavailableError(ServerError):
    """A server that is unreachable, is not ready, or refuses more requests for now."""


class ProcessEndedError(ServerUnavailableError):
    """A model process had ended when the request arrived, or it or the connection ended during the request."""

    may_have_ended_server = True


class DeadlineExceededError(ServerError, TimeoutError):
    """No answer came within the caller's time limit."""


class ModelNotFoundError(ServerError):
    """A model that the server does not serve."""


class AccessDeniedError(ServerError):
    """One side refuses the other: a missing or wrong certificate or key, or TLS on one side only."""


class InferenceFailedError(ServerError):
    """A failure of the server at a request (its log has the reason), or an invalid answer."""
