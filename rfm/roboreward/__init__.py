# SPDX-License-Identifier: MIT
"""RoboReward: a Qwen3-VL writes how far a robot has come, as a score from 1 to 5."""

from rfm.family import Family
from rfm.roboreward.checkpoint import REWARD_MODELS, load, reads

FAMILY = Family(name="rfm.roboreward", reads=reads, load=load, reward_models=REWARD_MODELS)
