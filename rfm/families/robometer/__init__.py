# SPDX-License-Identifier: MIT
"""RFM and Robometer: a vision-language model with reward heads scores frames and a task as a conversation."""

from rfm.engine.family import Family
from rfm.families.robometer.checkpoint import restore

FAMILY = Family(name="rfm.families.robometer", restore=restore, reader="rfm.published.robometer")
