# SPDX-License-Identifier: MIT
"""RoboReward: a Qwen3-VL writes how far a robot has come, as a score from 1 to 5."""

from rfm.engine.family import Family
from rfm.families.roboreward.checkpoint import RoboRewardCheckpoint

FAMILY = Family(name="rfm.families.roboreward", restore=RoboRewardCheckpoint.restore, reader="rfm.published.roboreward")
