# SPDX-License-Identifier: MIT
"""What a model says in Triton's log of requests that have no answer: one JSON object a line (docs/logs.md)."""

from __future__ import annotations

import json
import traceback
from collections.abc import Mapping, Sequence
from typing import Any

from rfm.triton_model.asked import FAILED, Asked


class RequestLog:
    """Writes with ``labels``, which tell the model.

    What failed is an error. What was refused or cancelled is only said where Triton's verbose log is on, so that
    no client can fill the log.
    """

    def __init__(self, labels: Mapping[str, str]) -> None:
        self._labels = dict(labels)

    def tell(self, asked: Asked[Any]) -> None:
        """Says what became of a request that has an error."""
        assert asked.error is not None
        said = {
            "request_id": asked.request_id,
            "sample_type": ",".join(sorted(asked.sample_types)),
            "error": str(asked.error),
        }
        self._write(asked.outcome, said, asked.error.__cause__)

    def tell_of_batch(self, batch: Sequence[Asked[Any]], error: Exception) -> None:
        """Says that requests failed together; each is answered alone then."""
        said = {"request_ids": [asked.request_id for asked in batch], "error": repr(error)}
        self._write(FAILED, said, error, event="batch_failed")

    def tell_of_end(self, error: Exception) -> None:
        """Says that the process ends, since it cannot score a blank sample any more."""
        self._write(FAILED, {"error": repr(error)}, error, event="instance_broken")

    def _write(
        self, outcome: str, said: Mapping[str, Any], cause: BaseException | None, event: str | None = None
    ) -> None:
        import triton_python_backend_utils as pb_utils

        told = {"event": event or f"request_{outcome}", **self._labels, **said}
        if cause is not None:
            told["traceback"] = "".join(traceback.format_exception(cause))
        line = json.dumps(told)
        if outcome == FAILED:
            pb_utils.Logger.log_error(line)
        else:
            pb_utils.Logger.log_verbose(line)
