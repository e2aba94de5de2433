# SPDX-License-Identifier: MIT
"""Log of requests without scores (docs/reference/logs_and_metrics.md)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from rfm.triton_model.request import FAILED, Request
from rfm_client.contract.process import about

logger = logging.getLogger(__name__)


def report(request: Request[Any]) -> None:
    """Log a request with an error.

    Failures are errors. Refused and cancelled requests are logged at DEBUG, so that clients cannot fill the log.
    """
    assert request.error is not None
    level = logging.ERROR if request.outcome == FAILED else logging.DEBUG
    sample_types = ",".join(sorted(request.sample_types))
    with about([request.request_id]):
        logger.log(level, "%s (%s): %s", request.outcome, sample_types, request.error, exc_info=request.error.__cause__)


def report_batch(batch: Sequence[Request[Any]], error: Exception) -> None:
    """Log requests that failed in a batch, before each is scored alone."""
    with about([request.request_id for request in batch]):
        logger.error("the batch failed, now each request is scored alone", exc_info=error)
