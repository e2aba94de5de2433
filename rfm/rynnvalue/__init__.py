# SPDX-License-Identifier: MIT
"""RynnValue: a Qwen3-VL with heads that predict the remaining seconds of a task at each frame."""

from rfm.family import Family
from rfm.rynnvalue.checkpoint import load, reads

FAMILY = Family(name="rfm.rynnvalue", reads=reads, load=load)
