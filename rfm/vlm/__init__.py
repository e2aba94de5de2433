# SPDX-License-Identifier: MIT
"""RFM and Robometer: raw frames and a task, as a conversation, into a vision-language model with reward heads."""

from rfm.family import Family
from rfm.vlm.checkpoint import load, reads

FAMILY = Family(name="rfm.vlm", reads=reads, load=load)
