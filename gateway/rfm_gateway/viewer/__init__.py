# SPDX-License-Identifier: MIT
"""What the page in the browser asks: videos and their reward curves, datasets, running episodes."""

from __future__ import annotations

import math
from collections.abc import Iterable


def numbers_or_null(scores: Iterable[float]) -> list[float | None]:
    """Scores as JSON has them: null for one that the checkpoint does not predict, or that is not there."""
    return [None if math.isnan(score) else score for score in scores]
