# SPDX-License-Identifier: MIT
"""The scores that models predict in place of progress, as the page draws them."""

from __future__ import annotations

from typing import Any

from rfm_client import FRAME_SCORES

INSTEAD = {name: FRAME_SCORES[name] for name in (score.replaced_by for score in FRAME_SCORES.values()) if name}
ABOUT: dict[str, dict[str, Any]] = {  # what the page's axes need
    name: {
        "short": f"time {score.short(name)}" if score.unit == "s" else score.short(name),
        "unit": score.unit,
        "bounds": [*score.bounds],
    }
    for name, score in INSTEAD.items()
}
