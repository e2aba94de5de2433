# SPDX-License-Identifier: MIT
"""Robo-Dopamine GRM: a Qwen-VL writes how far the AFTER images are from the BEFORE images, in percent."""

from rfm.engine.family import Family
from rfm.families.robodopamine.checkpoint import RoboDopamineCheckpoint

FAMILY = Family(
    name="rfm.families.robodopamine", restore=RoboDopamineCheckpoint.restore, reader="rfm.published.robodopamine"
)
