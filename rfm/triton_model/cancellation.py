# SPDX-License-Identifier: MIT
"""Requests whose clients have given up are not answered, where an answer is worth a question to Triton."""

from __future__ import annotations

import math
from typing import Any

from rfm.triton_model.request import CancelledError, Request

WORTH_CHECKING_S = 10e-3  # for one answer: to ask Triton's process takes 0.1 ms a request


class Cancellation:
    """Finds requests that their clients have cancelled.

    answer_s: seconds that each answer of the last batch took; to be set
    """

    def __init__(self) -> None:
        self.answer_s = math.inf

    def of(self, request: Request[Any]) -> CancelledError | None:
        """The error of a request that its client has cancelled; else None."""
        if self.answer_s >= WORTH_CHECKING_S and request.is_cancelled():
            return CancelledError("cancelled by the client")
        return None
