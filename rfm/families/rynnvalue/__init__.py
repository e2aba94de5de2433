# SPDX-License-Identifier: MIT
"""RynnValue: a Qwen3-VL with heads that predict at each frame how many seconds the task still takes."""

from rfm.engine.family import Family
from rfm.families.rynnvalue.checkpoint import RynnCheckpoint

FAMILY = Family(name="rfm.families.rynnvalue", restore=RynnCheckpoint.restore, reader="rfm.published.rynnvalue")
