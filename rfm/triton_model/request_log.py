# SPDX-License-Identifier: MIT
"""Log of requests without scores: a JSON object a line in Triton's log (docs/reference/logs_and_metrics.md)."""

from __future__ import annotations

import json
import traceback
from collections.abc import Mapping, Sequence
from typing import Any

from rfm.triton_model.request import FAILED, Request


class RequestLog:
    """Writes entries with ``labels``, which name the model.

    Failures are errors. Refused and cancelled requests go to Triton's verbose log, so that clients cannot fill the log.
    """

    def __init__(self, labels: Mapping[str, str]) -> None:
        self._labels = dict(labels)

    def report(self, request: Request[Any]) -> None:
        """Log a request with an error."""
        assert request.error is not None
        sample_types = ",".join(sorted(request.sample_types))
        fields = {"request_id": request.request_id, "sample_type": sample_types, "error": str(request.error)}
        self._write(f"request_{request.outcome}", fields, request.error.__cause__, is_error=request.outcome == FAILED)

    def report_batch(self, batch: Sequence[Request[Any]], error: Exception) -> None:
        """Log requests that failed in a batch, before each is scored alone."""
        fields = {"request_ids": [request.request_id for request in batch], "error": repr(error)}
        self._write("batch_failed", fields, error, is_error=True)

    def note(self, text: str) -> None:
        """Log a remark for the operator."""
        import triton_python_backend_utils as pb_utils

        pb_utils.Logger.log_info(json.dumps({"event": "note", **self._labels, "note": text}))

    def _write(self, event: str, fields: Mapping[str, Any], cause: BaseException | None, *, is_error: bool) -> None:
        import triton_python_backend_utils as pb_utils

        entry = {"event": event, **self._labels, **fields}
        if cause is not None:
            entry["traceback"] = "".join(traceback.format_exception(cause))
        write = pb_utils.Logger.log_error if is_error else pb_utils.Logger.log_verbose
        write(json.dumps(entry))
