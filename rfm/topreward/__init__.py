# SPDX-License-Identifier: MIT
"""TOPReward: the probability with which an ordinary Qwen3-VL says that a video completes a task."""

from rfm.family import Family
from rfm.topreward.checkpoint import REWARD_MODELS, load, reads

FAMILY = Family(name="rfm.topreward", reads=reads, load=load, reward_models=REWARD_MODELS)
