# SPDX-License-Identifier: MIT
"""Errors for invalid values, which carry fields, and errors from a call to the server. No error becomes a number."""

from __future__ import annotations

from traceback import clear_frames
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from typing_extensions import Self


class LocatedError(Exception):
    """An invalid value and where it is, reported as ``where: expected X, got Y; remedy``.

    where: the field, setting or file; empty: unknown
    expected, got, remedy: parts of ``problem``; empty if its text comes from elsewhere
    """

    where = expected = got = remedy = ""

    def __init__(self, problem: str, where: object = "") -> None:
        super().__init__(problem)
        self.where = str(where)

    @classmethod
    def at(cls, where: object, expected: str, got: object, remedy: str = "") -> Self:
        """Return the error for a value that is not as expected."""
        if isinstance(got, OSError) and got.strerror:
            got = f"{got.filename}: {got.strerror}" if got.filename else got.strerror
        error = cls(f"expected {expected}, got {got}{'; ' if remedy else ''}{remedy}", where)
        error.expected, error.got, error.remedy = expected, str(got), remedy
        return error

    @classmethod
    def like(cls, error: LocatedError, **changed: Any) -> Self:
        """Return an error of this class with another error's fields, some of them changed."""
        made = cls(*error.args)
        vars(made).update({**vars(error), **changed})
        return made

    @property
    def problem(self) -> str:
        """The message without ``where``."""
        return str(self.args[0])

    def __str__(self) -> str:
        return f"{self.where}: {self.problem}" if self.where else self.problem

    def inside(self, where: object) -> Self:
        """Return the error with the enclosing object's name before its field: ``where.field: ...``."""
        return type(self).like(self, where=f"{where}.{self.where}" if self.where else str(where))


def clear_variables(error: BaseException | None) -> None:
    """Clear the local variables of functions that an error and its causes have left.

    A variable that holds an error from the same function forms a reference cycle. The request's arrays would stay in
    memory until Python's cycle collector runs.
    """
    while error is not None:
        clear_frames(error.__traceback__)
        error = error.__cause__


class InvalidValueError(LocatedError, ValueError):
    """An invalid argument or setting."""


class RewardError(Exception):
    """Base class for this library's errors.

    request_id: the failed request's id in the server's log, appended to the message; None: no request was sent
    may_have_ended_server: True if a model process or the connection ended, perhaps because of the request
    """

    request_id: str | None = None
    may_have_ended_server = False

    @property
    def message(self) -> str:
        """The error's description, without the request id."""
        return super().__str__()

    def __str__(self) -> str:
        return self.message if self.request_id is None else f"{self.message} (request {self.request_id})"


class InvalidSampleError(RewardError, InvalidValueError):
    """An invalid sample. source: its video or picture, named at the end of the message; empty: none."""

    source = ""

    @property
    def problem(self) -> str:
        """The message without the field."""
        return f"{super().problem} ({self.source})" if self.source else super().problem


class ClientClosedError(RewardError, RuntimeError):
    """The client was closed before or during the call."""


class ServerError(RewardError):
    """The server or the connection to it failed; the sample may be valid.

    fault, remedy: parts of the message, if it has a remedy for library users; otherwise empty
    """

    fault = remedy = ""


class ServerUnavailableError(ServerError):
    """The server is unreachable, not ready, lacks a model that answered before, or refuses more requests for now."""


class ProcessEndedError(ServerUnavailableError):
    """A model process had ended when the request arrived, or it or the connection ended during the request."""

    may_have_ended_server = True


class DeadlineExceededError(ServerError, TimeoutError):
    """No answer came within the caller's time limit."""


class ModelNotFoundError(ServerError):
    """The server does not serve this model, and has not served it to this client before."""


class AccessDeniedError(ServerError):
    """One side refuses the other: a missing or wrong certificate or key, or TLS on one side only."""


class InferenceFailedError(ServerError):
    """The server failed on a request (its log has the reason), or its answer is invalid."""
