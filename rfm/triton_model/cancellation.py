# SPDX-License-Identifier: MIT
"""Requests whose clients have given up are not answered, where an answer is worth a question to Triton."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from rfm.execution import Execution
from rfm.triton_model.request import CancelledError, Request

WORTH_CHECKING_S = 10e-3  # for one answer: to ask Triton's process takes 0.1 ms a request

Question = TypeVar("Question")
Answer = TypeVar("Answer")


class Cancellation:
    """Finds requests that their clients have cancelled.

    answer_s: seconds that each answer of the last batch took
    """

    def __init__(self) -> None:
        self.answer_s = math.inf

    def check(self, request: Request[Any]) -> None:
        """Raises CancelledError for a request that its client has cancelled."""
        if self.answer_s >= WORTH_CHECKING_S and request.inference.is_cancelled():
            raise CancelledError("cancelled by the client")

    def timed(
        self,
        answer: Callable[[Sequence[Question], Execution], Sequence[Answer]],
        questions: Sequence[Question],
        execution: Execution,
    ) -> Sequence[Answer]:
        """What ``answer`` gives. Its time per answer is kept."""
        started_s = time.perf_counter()
        answers = answer(questions, execution)
        self.answer_s = (time.perf_counter() - started_s) / max(len(questions), 1)
        return answers
