# SPDX-License-Identifier: MIT
"""Robo-Dopamine GRM: a Qwen-VL writes how far the images AFTER are from those BEFORE, in percent."""

from rfm.robodopamine.checkpoint import RoboDopamineCheckpoint

FAMILY = RoboDopamineCheckpoint.family("rfm.robodopamine")
