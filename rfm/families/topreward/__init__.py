# SPDX-License-Identifier: MIT
"""TOPReward: the probability with which an ordinary Qwen3-VL says that a video completes a task."""

from rfm.engine.family import Family
from rfm.families.topreward.checkpoint import TopRewardCheckpoint

FAMILY = Family(name="rfm.families.topreward", restore=TopRewardCheckpoint.restore, reader="rfm.published.topreward")
