# SPDX-License-Identifier: MIT
"""Scores in JSON, which has no NaN."""

from __future__ import annotations

import math
from collections.abc import Iterable


def numbers_or_null(scores: Iterable[float]) -> list[float | None]:
    """Return scores for JSON, with null for a missing or not predicted score."""
    return [None if math.isnan(score) else score for score in scores]
