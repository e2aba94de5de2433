# SPDX-License-Identifier: MIT
"""Rewards for vectors of environments, also with torch tensors."""

from __future__ import annotations

from contextlib import closing
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space

from coded_env import SIZE_PX, Code, CodedEnv, CodeReader, Recorder
from environments import MODEL, TASK, LateClient, assert_close, cart_pole, progress
from rfm_client import InvalidSampleError, RewardClient
from rfm_rl import RewardModelVectorWrapper, RewardModelWrapper, RewardOptions
from servers import Served

NEXT_STEP, SAME_STEP, DISABLED = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED
TASKS = ["task 0", "task 1"]
LENGTHS = (3,), (4, 1, 2)  # steps of the episodes by environment, in turn
ACTIONS = np.zeros(2, int)


def options(**more: Any) -> RewardOptions:
    return RewardOptions(sampling="all", **{"frames_from": "pixels", **more})


def test_a_reset_of_a_vector_cancels_open_requests_of_the_environments_it_resets(late: LateClient) -> None:
    tasks, options = [TASK, "let the pole fall"], RewardOptions(sampling="all", blocking=False)
    env = RewardModelVectorWrapper(SyncVectorEnv([cart_pole] * 2, autoreset_mode=DISABLED), late, tasks, options)
    env.reset(seed=0)
    late.hold(1)
    env.step(np.array([0, 1]))
    env.reset(seed=0, options={"reset_mask": np.array([False, True])})
    assert [answer.cancelled() for answer in late.submitted] == [False, True]
    env.close()
    assert [answer.cancelled() for answer in late.submitted] == [True, True]


@pytest.mark.slow
def test_wrapped_environments_work_in_processes_of_their_own(served: Served, client: RewardClient) -> None:
    connect = partial(RewardClient, served.url("grpc"), model=MODEL)

    def env_fn() -> gym.Env[Any, Any]:
        env = gym.make("CartPole-v1", render_mode="rgb_array")
        return RewardModelWrapper(env, connect, "balance the pole", RewardOptions(max_frames=4))

    env = AsyncVectorEnv([env_fn] * 2, context="spawn")
    env.reset(seed=[5, 6])
    videos = [[frame] for frame in env.render()]
    for _ in range(2):
        rewards = env.step(np.array([0, 1]))[1]
        for video, frame in zip(videos, env.render(), strict=True):
            video.append(frame)
    env.close()
    assert_close(rewards, [progress(client, video, [2], max_frames=4)[0] for video in videos])


def test_a_vector_that_does_not_tell_the_last_frame_is_refused(recorder: Recorder) -> None:
    class Silent(SyncVectorEnv):
        def step(self, actions: Any) -> Any:
            *told, _ = super().step(actions)
            return *told, {}

    env = RewardModelVectorWrapper(Silent([CodedEnv] * 2, autoreset_mode=SAME_STEP), recorder, TASKS, options())
    env.reset(seed=0)
    for _ in range(2):
        env.step(ACTIONS)
    with pytest.raises(
        InvalidSampleError,
        match=r"^infos: expected final_obs of the environments \[0, 1\], .*NEXT_STEP, or .*auto_reset=True$",
    ):
        env.step(ACTIONS)
    with pytest.raises(
        ResetNeeded, match=r"^step: expected a reset of the environments \[0, 1\], since an earlier call failed"
    ):
        env.step(ACTIONS)


@pytest.mark.slow
def test_rendered_frames_of_lerobot_s_environments_in_processes_are_refused(recorder: Recorder) -> None:
    """Its VLABench resets in the successful step without a sign, which no other process sees."""
    env = CodedEnv()
    env.__module__ = "lerobot.envs.vlabench"
    with (
        closing(AsyncVectorEnv([lambda: env], autoreset_mode=NEXT_STEP)) as workers,
        pytest.raises(ValueError, match=r"^frames_from: expected a source .* 'pixels', for LeRobot's .*, got render"),
    ):
        RewardModelVectorWrapper(workers, recorder, TASK, options(frames_from=None))


@pytest.mark.slow
def test_a_reset_that_workers_would_do_twice_is_refused(recorder: Recorder) -> None:
    makers = [partial(CodedEnv, number, (1,)) for number in range(2)]
    workers = AsyncVectorEnv(makers, autoreset_mode=NEXT_STEP, shared_memory=False, context="spawn")
    with closing(RewardModelVectorWrapper(workers, recorder, TASKS, options())) as env:
        env.reset()
        env.step(ACTIONS)
        with pytest.raises(ValueError, match=r"^reset: expected none .* environments \[0, 1\], .*shared_memory=True$"):
            env.reset()
        env.step(ACTIONS)
        env.reset()
        env.step(ACTIONS)
    assert recorder.calls[-1] == [([(number, 2, 0), (number, 2, 1)], TASKS[number]) for number in range(2)]


# Vectors of torch tensors, and batches of environments in a single environment.


class OnDevice(torch.Tensor):
    """A tensor as if on a GPU: numpy cannot read it."""

    def __array__(self, *_args: Any, **_options: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu()")

    def numpy(self, **_options: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu()")

    def cpu(self, *_args: Any) -> torch.Tensor:
        return self.as_subclass(torch.Tensor)


def on_device(array: Any) -> OnDevice:
    return torch.tensor(np.asarray(array)).as_subclass(OnDevice)


class TensorVector(SyncVectorEnv):
    """Returns tensors, with SAME_STEP as ManiSkillVectorEnv does, and integers for terminations."""

    def __init__(self, mode: AutoresetMode) -> None:
        super().__init__([partial(CodedEnv, *each) for each in enumerate(LENGTHS)], autoreset_mode=mode)
        self.render_mode = "rgb_array"

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        if self.metadata["autoreset_mode"] is SAME_STEP:
            options = None  # which it does not read
        observations, infos = super().reset(seed=seed, options=options)
        return {"pixels": on_device(observations["pixels"])}, infos

    def step(self, actions: Any) -> Any:
        assert isinstance(actions, torch.Tensor)
        observations, rewards, terminations, truncations, infos = super().step(actions.cpu().numpy())
        final = infos.pop("final_obs", None)
        if final is not None:
            shown = [observations["pixels"][n] if each is None else each["pixels"] for n, each in enumerate(final)]
            infos["final_observation"] = {"pixels": on_device(np.stack(shown))}
            infos["_final_observation"] = on_device(infos.pop("_final_obs"))
        told = {"pixels": on_device(observations["pixels"])}, on_device(rewards > 0)  # as a sparse reward of ManiSkill
        return *told, on_device(terminations.astype(int)), on_device(truncations), infos

    def render(self) -> Any:
        return on_device(super().render())


def rolled(env: Any, mode: AutoresetMode, actions: Any) -> list[tuple[Any, ...]]:
    env.reset()
    told = []
    for _ in range(9):
        told.append(env.step(actions))
        ended = np.flatnonzero([bool(end) for end in told[-1][2] | told[-1][3]])
        if ended.size and mode is DISABLED:
            env.reset(options={"reset_mask": [number in ended for number in range(2)]})
    return told


@pytest.mark.parametrize(("mode", "source"), [(NEXT_STEP, None), (SAME_STEP, "pixels"), (DISABLED, "pixels")])
def test_tensors_are_paid_as_arrays_would_be(mode: AutoresetMode, source: str | None) -> None:
    rewarded = options(frames_from=source, mode="delta", add_to_env_reward=True)
    arrays = SyncVectorEnv([partial(CodedEnv, *each) for each in enumerate(LENGTHS)], autoreset_mode=mode)
    with Recorder() as left, Recorder() as right:
        expected = rolled(RewardModelVectorWrapper(arrays, left, TASKS, rewarded), mode, ACTIONS)
        env = RewardModelVectorWrapper(TensorVector(mode), right, TASKS, rewarded)
        told = rolled(env, mode, on_device([0, 0]))
    assert right.calls == left.calls
    for step, wanted in zip(told, expected, strict=True):
        assert [type(each) for each in step[1:4]] == [OnDevice] * 3
        assert [each.dtype for each in step[1:4]] == [torch.float32, torch.bool, torch.bool]
        for each, array in zip(step[1:4], wanted[1:4], strict=True):
            np.testing.assert_allclose(each.cpu().numpy(), array, atol=1e-6)
        of_model, wanted_of_model = step[4].get("final_info", step[4]), wanted[4].get("final_info", wanted[4])
        np.testing.assert_array_equal(of_model["reward_model"]["progress"], wanted_of_model["reward_model"]["progress"])


def test_a_partial_reset_that_a_vector_does_not_read_is_refused(recorder: Recorder) -> None:
    env = RewardModelVectorWrapper(TensorVector(SAME_STEP), recorder, TASKS, options())
    env.reset()
    with pytest.raises(ValueError, match=r"^options: expected a reset of all environments, got env_idx; ManiSkill"):
        env.reset(options={"env_idx": torch.tensor([0])})
    env.step(on_device([0, 0]))
    with pytest.raises(ValueError, match=r"^reset_mask: expected bool \[2\], got int64 \[1\]$"):
        env.reset(options={"reset_mask": [0]})
    with pytest.raises(ValueError, match=r"^reset_mask: expected a vector that takes it .*; reset all environments$"):
        env.reset(options={"reset_mask": [True, False]})
    with pytest.raises(ResetNeeded):
        env.step(on_device([0, 0]))
    env.reset()
    env.step(on_device([0, 0]))


class Batch(gym.Env[Any, Any]):
    """A batch of environments in a single environment, as in ManiSkill and Isaac Lab."""

    single_observation_space = gym.spaces.Dict({"pixels": gym.spaces.Box(0, 255, (SIZE_PX, SIZE_PX, 3), np.uint8)})

    def __init__(self, num_envs: int) -> None:
        self.num_envs, self.render_mode = num_envs, "rgb_array"
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = gym.spaces.Discrete(2)


class Unbatched(gym.Wrapper[Any, Any, Any, Any]):
    """A batch's only environment, as in ManiSkill's CPUGymWrapper."""

    def __init__(self, env: Batch) -> None:
        super().__init__(env)
        self.observation_space = env.single_observation_space


BATCH = r"an Env that is a batch .*\.Batch; ManiSkill: .*Isaac Lab .*episodes\("
OTHERS = {
    "a batch of one": (lambda: gym.wrappers.TimeLimit(Batch(1), 5), BATCH),
    "no environment": (object, r".*object; .*wrap each environment in Rew"),
}


@pytest.mark.parametrize("wrapper", [RewardModelWrapper, RewardModelVectorWrapper])
@pytest.mark.parametrize(("make", "message"), OTHERS.values(), ids=OTHERS)
def test_another_kind_of_environment_is_refused_with_the_remedy(
    recorder: Recorder, wrapper: Any, make: Any, message: str
) -> None:
    with pytest.raises(TypeError, match=rf"^env: expected a gymnasium \w+, got {message}"):
        wrapper(make(), recorder, TASKS[0])


def test_the_only_environment_of_a_batch_is_taken(recorder: Recorder) -> None:
    only = gym.wrappers.FlattenObservation(Unbatched(Batch(1)))
    assert RewardModelWrapper(only, recorder, TASKS[0]).unwrapped.num_envs == 1  # type: ignore[attr-defined]


class Rising(CodeReader):
    """Scores each frame by its step."""

    def scores(self, codes: list[Code]) -> dict[str, Any]:
        return {"progress": np.array([0.0, 0.1, 0.3, 0.6])[[step for *_, step in codes]]}


def test_torchrl_gets_the_rewards_of_each_environment_and_resets_those_that_have_ended() -> None:
    torchrl = pytest.importorskip("torchrl.envs", reason="make test-newest installs it")
    vector = SyncVectorEnv([partial(CodedEnv, 0, (3,)), partial(CodedEnv, 1, (2,))], autoreset_mode=DISABLED)
    with Recorder(server=Rising()) as client:
        env = torchrl.GymWrapper(RewardModelVectorWrapper(vector, client, TASKS, options(mode="delta")))
        rewards = env.rollout(6, break_when_any_done=False)["next", "reward"][..., 0]
    expected = [[0.1, 0.2, 0.3, 0.1, 0.2, 0.3], [0.1, 0.2, 0.1, 0.2, 0.1, 0.2]]
    np.testing.assert_allclose(rewards, expected, atol=1e-6)
