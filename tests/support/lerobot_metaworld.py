# SPDX-License-Identifier: MIT
"""LeRobot's Meta-World in each wrapper, for a Python with LeRobot: ``test_lerobot_itself.py`` runs it.

MUJOCO_GL=egl python tests/support/lerobot_metaworld.py grpc://localhost:8001
"""

import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from lerobot.envs.metaworld import MetaworldEnv
from stable_baselines3.common.vec_env import DummyVecEnv

from rfm_client import InvalidSampleError, RewardClient
from rfm_rl import RewardModelVectorWrapper, RewardModelWrapper, RewardOptions, SuccessRule
from rfm_rl.sb3 import RenderedFrame, RewardModelVecEnv

TASK = "reach the goal"
NEAR_M = 0.07  # from the goal: a few steps before a success


class Near(MetaworldEnv):  # type: ignore[misc]
    """LeRobot's environment, from a few steps before a success. ``action``: the expert's"""

    def reset(self, seed: int | None = None, **options: Any) -> Any:
        super().reset(seed=0, **options)
        info = {"obj_to_target": 1.0}
        while info["obj_to_target"] > NEAR_M:
            raw, *_, info = self._env.step(self.action)
            self.action = self.expert_policy.get_action(raw).clip(-1, 1).astype(np.float32)
        return self._format_raw_obs(raw), {"is_success": False}

    def _format_raw_obs(self, raw: Any) -> Any:
        self.action = self.expert_policy.get_action(raw).clip(-1, 1).astype(np.float32)
        return super()._format_raw_obs(raw)


def vector(mode: AutoresetMode) -> Callable[..., Any]:
    return lambda env, *more: RewardModelVectorWrapper(SyncVectorEnv([lambda: env], autoreset_mode=mode), *more)


def of_sb3(env: Any, client: RewardClient, task: str, options: RewardOptions) -> Any:
    inside = RenderedFrame(env) if options.renders else env
    return RewardModelVecEnv(DummyVecEnv([lambda: inside]), client, task, options)


DOORS: dict[str, Callable[..., Any]] = {"single": RewardModelWrapper, "VecEnv": of_sb3}
DOORS |= {mode.name: vector(mode) for mode in AutoresetMode}


def last_reward(name: str, client: RewardClient, env: Near, count: int, options: RewardOptions) -> float:
    wrapped = DOORS[name](env, client, TASK, options)
    wrapped.reset()
    rewards = [wrapped.step(env.action if name == "single" else env.action[None])[1] for _ in range(count)]
    return float(np.ravel(rewards)[-1])


def main(url: str) -> None:
    env = Near("reach-v3", observation_width=480, observation_height=480)
    frames, info = [env.reset()[0]["pixels"]], {}
    while "final_info" not in info:
        observation, *_, info = env.step(env.action)
        frames.append(observation["pixels"])
    assert not np.array_equal(frames[-1], env.render())  # it has reset
    with RewardClient(url) as client:
        with client.episode(TASK) as episode:
            progress = [episode.add(frame).progress for frame in frames]
        for name in DOORS:
            paid = last_reward(name, client, env, len(frames) - 1, RewardOptions(frames_from="pixels"))
            np.testing.assert_allclose(paid, progress[-1], atol=1e-5, err_msg=name)
        for name in DOORS.keys() - {"SAME_STEP"}:  # which takes no rendered frames
            try:
                last_reward(name, client, env, len(frames) - 1, RewardOptions())
            except InvalidSampleError as error:
                assert "frames_from='pixels'" in str(error)
            else:
                raise AssertionError(f"{name}: expected an error, got a reward for the next episode's first frame")
        own: Any = gymnasium.make("Meta-World/MT1", env_name="reach-v3", render_mode="rgb_array")
        wrapped = RewardModelWrapper(own, client, TASK, RewardOptions(terminate_on_success=SuccessRule(0.0)))
        wrapped.reset(seed=0)
        _, reward, terminated, _, info = wrapped.step(own.action_space.sample())
        assert (terminated, info["episode"]) == (True, {"r": reward, "l": 1})
    print(f"all is well: {len(frames) - 1} steps, progress {progress[-1]:.3f}")


if __name__ == "__main__":
    main(sys.argv[1])
