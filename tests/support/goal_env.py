# SPDX-License-Identifier: MIT
"""A goal environment whose reward no reward model would give."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from coded_env import frame_of
from rfm_client import UInt8Array

OWN_REWARD = -100.0
LENGTH = 5  # steps of an episode


class Reach(gym.Env[Any, Any]):
    """Moves a point. A frame's first pixel holds the episode and the step."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}
    render_mode = "rgb_array"
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    observation_space = gym.spaces.Dict(
        {key: gym.spaces.Box(-1, 1, (2,), np.float32) for key in ("observation", "achieved_goal", "desired_goal")}
    )

    def __init__(self) -> None:
        self.episode, self.t = -1, 0
        self.position = self.goal = np.zeros(2, np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.episode, self.t = self.episode + 1, 0
        self.position = np.zeros(2, np.float32)
        self.goal = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self._observed(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.position = np.clip(self.position + action / LENGTH, -1, 1).astype(np.float32)
        self.t += 1
        return self._observed(), OWN_REWARD, False, self.t == LENGTH, {}

    def compute_reward(self, achieved: Any, desired: Any, infos: Any) -> Any:
        return np.full(np.shape(achieved)[:-1], OWN_REWARD)

    def render(self) -> UInt8Array:  # type: ignore[override]
        return frame_of(0, self.episode % 256, self.t)

    def _observed(self) -> dict[str, Any]:
        return {"observation": self.position, "achieved_goal": self.position, "desired_goal": self.goal}
