# SPDX-License-Identifier: MIT
"""Make an environment of Meta-World, also in other processes."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.wrappers import TimeLimit


def meta_world() -> gym.Env[Any, Any]:
    import metaworld  # noqa: F401  # registers the environments

    picture = {"render_mode": "rgb_array", "camera_name": "corner2", "width": 96, "height": 96}
    return TimeLimit(gym.make("Meta-World/MT1", env_name="reach-v3", seed=0, disable_env_checker=True, **picture), 100)
