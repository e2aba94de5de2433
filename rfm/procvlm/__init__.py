# SPDX-License-Identifier: MIT
"""ProcVLM: a Qwen3-VL thinks about the latest eight frames, and writes progress in percent. Unverified."""

from rfm.procvlm.model import ProcVlmCheckpoint

FAMILY = ProcVlmCheckpoint.family("rfm.procvlm")
