# SPDX-License-Identifier: MIT
"""RynnValue: a Qwen3-VL with heads that predict the remaining seconds of a task at each frame."""

from rfm.engine.family import Family
from rfm.families.rynnvalue.checkpoint import RynnCheckpoint

FAMILY = Family(name="rfm.families.rynnvalue", restore=RynnCheckpoint.restore, reader="rfm.published.rynnvalue")
