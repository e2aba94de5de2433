# SPDX-License-Identifier: MIT
"""RFM and Robometer: a vision-language model with reward heads scores frames and a task as a conversation."""

from rfm.family import Family
from rfm.vlm.checkpoint import load, reads

FAMILY = Family(name="rfm.vlm", reads=reads, load=load)
