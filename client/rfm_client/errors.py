# SPDX-License-Identifier: MIT
"""What can go wrong when asking for a reward.

    RewardError
    +-- InvalidSampleError        the sample is at fault; sending it again gives the same answer
    +-- ServerError               the server is at fault, or cannot be reached
        +-- ServerUnavailableError    no connection, not ready, or its queue is full
        +-- DeadlineExceededError     no answer within the time that the caller gave
        +-- ModelNotFoundError        the server does not serve a model of that name
        +-- InferenceFailedError      the server tried and failed; its log has the reason

No error is ever replaced by a number.
"""

from __future__ import annotations


class RewardError(Exception):
    """Base of every error that this library raises."""


class InvalidSampleError(RewardError, ValueError):
    """A sample that cannot be scored, told as ``where: expected X, got Y``."""

    @classmethod
    def at(cls, where: str, expected: str, got: str) -> InvalidSampleError:
        """The error at the field ``where``."""
        return cls(f"{where}: expected {expected}, got {got}")

    def inside(self, where: str) -> InvalidSampleError:
        """The same error, seen from the object that holds the field: ``where.field: ...``."""
        return type(self)(f"{where}.{self}")


class ServerError(RewardError):
    """The server did not answer as it should; the sample may be fine."""


class ServerUnavailableError(ServerError):
    """The server cannot be reached, is not ready, or refuses more work for now."""


class DeadlineExceededError(ServerError, TimeoutError):
    """No answer came within the caller's time limit."""


class ModelNotFoundError(ServerError):
    """The server does not serve the model that was asked for."""


class InferenceFailedError(ServerError):
    """The server failed while scoring; its log names the reason."""
