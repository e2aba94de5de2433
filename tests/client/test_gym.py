# SPDX-License-Identifier: MIT
"""CartPole, filmed, with the reward of a served checkpoint. What is expected is asked for frame by frame."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import AddRenderObservation, RecordEpisodeStatistics

from reference_server import Served
from rfm_client import (
    InvalidSampleError,
    ModelNotFoundError,
    ProgressResult,
    RewardClient,
    ServerUnavailableError,
    Trajectory,
)
from rfm_client.contract import wire
from rfm_client.contract.samples import UInt8Array
from rfm_client.gym import RewardModelVectorWrapper, RewardModelWrapper, RewardOptions, SuccessRule
from rfm_client.transport.access import Access
from rfm_client.transport.calls import Answer, GrpcTransport

MODEL = "enc_c1_t1_disc10"
MAX_FRAMES = 16  # of that checkpoint
TASK = "balance the pole"
PUSH_RIGHT = 1  # the pole falls within ten steps
SIZE = 240, 160  # pixels; fewer would not show the cart
TOLERANCE = 1e-5

Film = list[UInt8Array]


class Camera(gym.Wrapper[Any, Any, Any, Any]):
    """Films each episode for the test: ``films[-1][t]`` is what was to be seen after step t."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.films: list[Film] = []

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        answer = self.env.reset(**options)
        self.films.append([np.array(self.env.render())])
        return answer

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        answer = self.env.step(action)
        self.films[-1].append(np.array(self.env.render()))
        return answer


def cart_pole(**options: Any) -> gym.Env[Any, Any]:
    env = gym.make("CartPole-v1", render_mode="rgb_array", **options)
    env.unwrapped.screen_width, env.unwrapped.screen_height = SIZE  # type: ignore[attr-defined]
    return env


def cart_pole_with_pixels() -> gym.Env[Any, Any]:
    return AddRenderObservation(cart_pole(), render_only=False, render_key="pixels", obs_key="state")


@pytest.fixture
def client(served: Served) -> Iterator[RewardClient]:
    with served.client("grpc", MODEL) as client:
        yield client


def scores(client: RewardClient, film: Film, step: int, max_frames: int = MAX_FRAMES) -> ProgressResult:
    """Of the frames up to a step, or as many of them as may be sent."""
    picked = np.linspace(0, step, min(step + 1, max_frames)).astype(int)
    return client.progress(Trajectory(frames=np.stack([film[index] for index in picked]), task=TASK))


def progress(client: RewardClient, film: Film, steps: Sequence[int], max_frames: int = MAX_FRAMES) -> list[float]:
    return [float(scores(client, film, step, max_frames).progress[-1]) for step in steps]


def play(env: gym.Env[Any, Any], seed: int = 0) -> tuple[list[float], list[dict[str, Any]]]:
    """Rewards and infos of an episode; the reset's info is the first."""
    info = env.reset(seed=seed)[1]
    rewards, infos = play_on(env)
    return rewards, [info, *infos]


def play_on(env: gym.Env[Any, Any]) -> tuple[list[float], list[dict[str, Any]]]:
    """Rewards and infos from here to the end of the episode."""
    rewards: list[float] = []
    infos: list[dict[str, Any]] = []
    ended = False
    while not ended:
        _, reward, terminated, truncated, info = env.step(PUSH_RIGHT)
        rewards.append(float(reward))
        infos.append(info)
        ended = terminated or truncated
    return rewards, infos


def assert_close(left: Any, right: Any) -> None:
    np.testing.assert_allclose(left, right, rtol=0, atol=TOLERANCE)


def test_each_step_is_paid_the_progress_of_its_frame(client: RewardClient) -> None:
    camera = Camera(cart_pole())
    rewards, infos = play(RewardModelWrapper(camera, client, TASK))
    (film,) = camera.films
    assert len(rewards) >= 8
    assert_close(rewards, progress(client, film, range(1, len(film))))
    assert len({frame.tobytes() for frame in film}) > len(film) // 2  # the first steps look the same
    for step, info in enumerate(infos):
        answer = scores(client, film, step)
        told = info["reward_model"]
        assert_close([told["progress"], told["success"]], [answer.progress[-1], answer.success[-1]])
        assert (told["step"], told["lag"], told["skipped"]) == (step, 0, 0)
    assert "env_reward" not in infos[0]["reward_model"]
    assert [info["reward_model"]["env_reward"] for info in infos[1:]] == [1.0] * len(rewards)


def test_delta_pays_the_change_since_the_step_before(client: RewardClient) -> None:
    camera = Camera(cart_pole())
    rewards, _ = play(RewardModelWrapper(camera, client, TASK, RewardOptions(mode="delta")))
    values = progress(client, camera.films[0], range(len(rewards) + 1))
    assert_close(rewards, np.diff(values))
    assert_close(sum(rewards), values[-1] - values[0])


def test_the_reward_is_scaled_and_the_environment_s_is_added_as_it_is(client: RewardClient) -> None:
    camera = Camera(cart_pole())
    rewards, _ = play(RewardModelWrapper(camera, client, TASK, RewardOptions(scale=10, add_to_env_reward=True)))
    assert_close(rewards, 1 + 10 * np.array(progress(client, camera.films[0], range(1, len(rewards) + 1))))


@pytest.mark.parametrize("mode", ["absolute", "delta"])
def test_every_third_step_and_the_last_are_scored(client: RewardClient, mode: Any) -> None:
    camera = Camera(cart_pole())
    rewards, infos = play(RewardModelWrapper(camera, client, TASK, RewardOptions(mode=mode, every=3)))
    last = len(rewards)
    assert last % 3 != 0
    newest = [step if step == last else step - step % 3 for step in range(last + 1)]
    values = progress(client, camera.films[0], newest)
    assert_close(rewards, values[1:] if mode == "absolute" else np.diff(values))
    assert [info["reward_model"]["step"] for info in infos] == newest
    assert [info["reward_model"]["lag"] for info in infos] == [step - known for step, known in enumerate(newest)]


@pytest.mark.parametrize(("max_frames", "sent"), [(None, MAX_FRAMES), (3, 3)])
def test_a_long_episode_is_sent_evenly(client: RewardClient, max_frames: int | None, sent: int) -> None:
    camera = Camera(cart_pole(max_episode_steps=MAX_FRAMES + 5))
    env = RewardModelWrapper(camera, client, TASK, RewardOptions(max_frames=max_frames))
    env.reset(seed=0)
    rewards = [float(env.step(action)[1]) for action in [0, 1] * ((MAX_FRAMES + 5) // 2)]
    assert_close(rewards, progress(client, camera.films[0], range(1, len(rewards) + 1), sent))


def test_episodes_do_not_see_each_other_s_frames(client: RewardClient) -> None:
    camera = Camera(cart_pole())
    env = RewardModelWrapper(camera, client, TASK, RewardOptions(mode="delta"))
    for seed, film_index in ((1, 0), (2, 1)):
        rewards, _ = play(env, seed)
        assert_close(rewards, np.diff(progress(client, camera.films[film_index], range(len(rewards) + 1))))


def test_an_episode_ends_where_most_of_the_last_frames_succeed(client: RewardClient) -> None:
    camera = Camera(cart_pole())
    play(RewardModelWrapper(camera, client, TASK))
    film = camera.films[0]
    successes = [scores(client, film, step).success for step in range(len(film))]
    threshold = float(np.median([np.median(success[-3:]) for success in successes[1:]]))
    votes = [np.mean(success[-3:] >= threshold) > 0.5 for success in successes]
    expected = votes.index(True, 1)
    env = RewardModelWrapper(cart_pole(), client, TASK, RewardOptions(terminate_on_success=SuccessRule(threshold, 3)))
    rewards, _ = play(env)
    assert len(rewards) == expected < len(film) - 1


@pytest.mark.parametrize(("threshold", "every", "steps"), [(0.0, 1, 1), (0.0, 4, 4), (1.0, 1, 8)])
def test_only_a_scored_step_can_succeed(client: RewardClient, threshold: float, every: int, steps: int) -> None:
    options = RewardOptions(every=every, terminate_on_success=SuccessRule(threshold))
    rewards, _ = play(RewardModelWrapper(cart_pole(), client, TASK, options))
    assert len(rewards) == steps


def test_the_task_may_depend_on_the_reset(client: RewardClient) -> None:
    tasks = iter([TASK, "let the pole fall"])
    env = RewardModelWrapper(cart_pole(), client, lambda info: next(tasks) if info == {} else "")
    first, second = (env.reset(seed=0)[1]["reward_model"]["progress"] for _ in range(2))
    frames = np.array(env.render())[np.newaxis]
    for told, task in ((first, TASK), (second, "let the pole fall")):
        assert_close(told, client.progress(Trajectory(frames=frames, task=task)).last_progress)


def test_gymnasium_s_own_check_passes(served: Served) -> None:
    connect = partial(RewardClient, served.url("grpc"), model=MODEL)
    env = RewardModelWrapper(cart_pole(), connect, TASK)
    with pytest.warns(UserWarning) as warnings:
        check_env(env, skip_render_check=True, skip_close_check=True)  # which would make it anew, from its name
    assert all("different from the unwrapped" in str(w.message) or "infinity" in str(w.message) for w in warnings)
    env.close()


def test_outer_wrappers_may_ask_for_the_spec(client: RewardClient) -> None:
    spec = RecordEpisodeStatistics(RewardModelWrapper(cart_pole(), client, TASK)).spec
    assert spec is not None
    assert spec.id == "CartPole-v1"


# Where frames come from


def brightened(observation: dict[str, Any]) -> UInt8Array:
    return np.asarray(255 - observation["pixels"], np.uint8)


@pytest.mark.parametrize("source", ["pixels", brightened])
def test_frames_may_come_from_the_observation(client: RewardClient, source: Any) -> None:
    env = RewardModelWrapper(cart_pole_with_pixels(), client, TASK, RewardOptions(frames_from=source))
    observation, _ = env.reset(seed=0)
    film = [observation]
    for _ in range(3):
        observation, reward, *_ = env.step(PUSH_RIGHT)
        film.append(observation)
    frames = [each["pixels"] if source == "pixels" else 255 - each["pixels"] for each in film]
    assert_close(reward, progress(client, frames, [3]))


def test_frames_may_be_drawn_into_the_same_array(client: RewardClient) -> None:
    camera = Camera(cart_pole())
    canvas = np.empty((SIZE[1], SIZE[0], 3), np.uint8)

    def draw(_: Any) -> UInt8Array:
        canvas[:] = camera.films[-1][-1]
        return canvas

    rewards, _ = play(RewardModelWrapper(camera, client, TASK, RewardOptions(frames_from=draw)))
    assert_close(rewards, progress(client, camera.films[0], range(1, len(rewards) + 1)))


def test_a_frame_that_is_none_is_refused(client: RewardClient) -> None:
    env = RewardModelWrapper(cart_pole(), client, TASK, RewardOptions(frames_from=lambda state: state))
    with pytest.raises(InvalidSampleError, match=r"^frame: expected uint8 \[H, W, 3\], got float32 \[4\]$"):
        env.reset()


def test_a_frame_of_another_size_is_refused(client: RewardClient) -> None:
    env = RewardModelWrapper(cart_pole(), client, TASK)
    env.reset()
    env.unwrapped.screen_width, env.unwrapped.screen = 80, None  # type: ignore[attr-defined]
    message = r"^frame: expected uint8 \[160, 240, 3\], as the episode's first, got uint8 \[160, 80, 3\]$"
    with pytest.raises(InvalidSampleError, match=message):
        env.step(PUSH_RIGHT)


BAD_OPTIONS: dict[str, tuple[dict[str, Any], str]] = {
    "mode": ({"mode": "relative"}, "^mode: expected 'absolute' or 'delta', got 'relative'$"),
    "every": ({"every": 0}, "^every: expected at least 1, got 0$"),
    "max_pending": ({"max_pending": 0}, "^max_pending: expected at least 1, got 0$"),
    "max_frames": ({"max_frames": 0}, "^max_frames: expected at least 1, got 0$"),
    "frames_from": ({"frames_from": "pixels"}, r"^frames_from: expected a key of the observation \[\], got 'pixels'$"),
}


@pytest.mark.parametrize(("options", "message"), BAD_OPTIONS.values(), ids=BAD_OPTIONS)
def test_bad_options_are_refused(client: RewardClient, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RewardModelWrapper(cart_pole(), client, TASK, RewardOptions(**options))


def test_no_votes_at_all_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^last: expected at least 1, got 0$"):
        SuccessRule(last=0)


def test_an_environment_that_renders_nothing_is_refused(client: RewardClient) -> None:
    with pytest.raises(ValueError, match=r"^render_mode: expected 'rgb_array', .* got None$"):
        RewardModelWrapper(gym.make("CartPole-v1"), client, TASK)


def test_a_step_needs_a_reset(client: RewardClient) -> None:
    env = cart_pole()
    env.reset()
    with pytest.raises(gym.error.ResetNeeded, match=r"^step: expected a reset before it$"):
        RewardModelWrapper(env, client, TASK).step(PUSH_RIGHT)


# Errors


def test_a_model_that_is_not_served_is_no_reward(served: Served) -> None:
    with served.client("grpc", "not_served") as client:
        env = RewardModelWrapper(cart_pole(), client, TASK, RewardOptions(max_frames=4))
        with pytest.raises(ModelNotFoundError, match="not_served"):
            env.reset()
        with pytest.raises(ModelNotFoundError, match="not_served"):
            env.step(PUSH_RIGHT)


@pytest.mark.parametrize("blocking", [True, False])
def test_an_error_comes_out_of_the_step(client: RewardClient, blocking: bool) -> None:
    """At the latest where the episode ends, if the step does not wait."""
    steps = MAX_FRAMES + 4
    options = RewardOptions(max_frames=100, blocking=blocking, max_pending=steps)
    env = RewardModelWrapper(cart_pole(max_episode_steps=steps), client, TASK, options)
    env.reset(seed=0)
    with pytest.raises(InvalidSampleError, match=f"^num_frames: expected at most {MAX_FRAMES} .*, got"):
        for step in range(1, steps + 1):
            env.step(step % 2)
    assert step == MAX_FRAMES if blocking else step >= MAX_FRAMES


# Answers that come late


class SlowConnection(GrpcTransport):
    """To the real server; a question whose longest trajectory has a length that is held waits until it is let go."""

    def __init__(self, url: str) -> None:
        super().__init__(url, Access(), shared_memory=False)
        self.held: dict[int, Future[None]] = {}
        self.lengths: list[int] = []

    async def infer(self, model: str, inputs: wire.Tensors, outputs: Any, timeout_s: float, **_id: str) -> Answer:
        length = int(inputs[wire.NUM_FRAMES].max())
        self.lengths.append(length)
        if length in self.held:
            await asyncio.shield(asyncio.wrap_future(self.held[length]))  # several questions may wait for it
        return await super().infer(model, inputs, outputs, timeout_s)


class LateClient(RewardClient):
    """A client whose answers the test lets come when it wants."""

    def __init__(self, url: str) -> None:
        self.connection = SlowConnection(url)
        super().__init__(url, transports=[self.connection], model=MODEL, retry=False)
        self.submitted: list[Future[ProgressResult]] = []
        self.answers: dict[int, Future[ProgressResult]] = {}  # by step

    def hold(self, *steps: int) -> None:
        self.connection.held |= {step + 1: Future() for step in steps}

    def submit(self, sample: Any, **options: Any) -> Future[Any]:
        answer = super().submit(sample, **options)
        self.submitted.append(answer)
        self.answers[sample.trajectory.num_frames - 1] = answer
        return answer

    def let_come(self, *steps: int) -> None:
        for step in steps:
            if step + 1 in self.connection.held:
                self.connection.held.pop(step + 1).set_result(None)
            self.answers[step].result()


@pytest.fixture
def late(served: Served) -> Iterator[LateClient]:
    with LateClient(served.url("grpc")) as client:
        yield client


def not_blocking(late: LateClient, **options: Any) -> tuple[RewardModelWrapper, Camera]:
    camera = Camera(cart_pole())
    env = RewardModelWrapper(camera, late, TASK, RewardOptions(blocking=False, **options))
    env.reset(seed=0)
    return env, camera


# After which step which answers come, and which of them is the newest in use at the next one.
COMING: list[tuple[tuple[int, ...], int]] = [((), 0), ((), 0), ((2,), 2), ((1,), 2), ((3, 4), 4), ((), 4)]


@pytest.mark.parametrize("mode", ["absolute", "delta"])
def test_a_step_goes_on_with_the_newest_answer_that_has_come(client: RewardClient, late: LateClient, mode: Any) -> None:
    env, camera = not_blocking(late, mode=mode, max_pending=6)
    late.hold(*range(1, 7))
    rewards, told = [], []
    for come, _ in COMING:
        late.let_come(*come)
        _, reward, _, _, info = env.step(PUSH_RIGHT)
        rewards.append(reward)
        told.append(info["reward_model"])
    newest = [step for _, step in COMING]
    values = progress(client, camera.films[0], [0, *newest])
    assert_close(rewards, values[1:] if mode == "absolute" else np.diff(values))
    assert [each["step"] for each in told] == newest
    assert [each["lag"] for each in told] == [step - known for step, known in enumerate(newest, 1)]
    assert [each["skipped"] for each in told] == [0] * len(COMING)
    env.close()


def test_with_too_many_questions_open_a_step_is_skipped_and_counted(late: LateClient) -> None:
    env, _ = not_blocking(late, max_pending=2)
    late.hold(1, 2, 5)
    skipped = [env.step(PUSH_RIGHT)[4]["reward_model"]["skipped"] for _ in range(4)]
    assert skipped == [0, 0, 1, 2]
    late.let_come(1, 2)
    told = env.step(PUSH_RIGHT)[4]["reward_model"]
    assert (told["step"], told["lag"], told["skipped"]) == (2, 3, 2)
    assert sorted(late.answers) == [1, 2, 5]
    env.reset()
    assert env.step(PUSH_RIGHT)[4]["reward_model"]["skipped"] == 0


def test_the_last_step_waits_so_that_late_rewards_add_up(client: RewardClient, late: LateClient) -> None:
    env, camera = not_blocking(late, mode="delta", max_pending=2)
    late.hold(1, 2)
    rewards, infos = play_on(env)
    last = len(rewards)
    first_and_last = progress(client, camera.films[0], [0, last])
    assert rewards[:-1] == [0] * (last - 1)
    assert_close(sum(rewards), first_and_last[1] - first_and_last[0])
    told = infos[-1]["reward_model"]
    assert (told["step"], told["lag"], told["skipped"]) == (last, 0, last - 3)
    assert [late.answers[step].cancelled() for step in late.answers] == [True, True]


def test_what_is_open_at_the_end_may_be_dropped(client: RewardClient, late: LateClient) -> None:
    env, camera = not_blocking(late, mode="delta", max_pending=20, await_last=False)
    late.hold(*range(2, 20))
    env.step(PUSH_RIGHT)
    late.let_come(1)
    rewards, infos = play_on(env)
    values = progress(client, camera.films[0], [0, 1])
    assert_close(rewards, [values[1] - values[0]] + [0] * (len(rewards) - 1))
    assert infos[-1]["reward_model"]["step"] == 1
    assert sorted(late.answers) == list(range(1, len(rewards) + 1))  # the last step was not asked about
    assert all(late.answers[step].cancelled() for step in range(2, len(rewards) + 1))


def test_an_answer_to_an_older_episode_touches_no_newer_one(client: RewardClient, late: LateClient) -> None:
    env, camera = not_blocking(late)
    late.hold(1)
    env.step(PUSH_RIGHT)
    answer = late.answers[1]
    env.reset(seed=1)
    assert answer.cancelled()
    _, reward, _, _, info = env.step(PUSH_RIGHT)
    assert info["reward_model"]["step"] == 0
    assert_close(reward, progress(client, camera.films[1], [0]))


def test_success_ends_the_episode_at_the_step_at_which_it_is_known(client: RewardClient, late: LateClient) -> None:
    env, camera = not_blocking(late, terminate_on_success=SuccessRule(threshold=0.0))
    late.hold(1, 2)
    assert [env.step(PUSH_RIGHT)[2] for _ in range(2)] == [False, False]
    late.let_come(1)
    _, reward, terminated, truncated, info = env.step(PUSH_RIGHT)
    assert (terminated, truncated, info["reward_model"]["step"]) == (True, False, 3)
    assert info["reward_model"]["succeeded"]
    assert_close(reward, progress(client, camera.films[0], [3]))


def test_an_episode_that_has_succeeded_stays_so(client: RewardClient, late: LateClient) -> None:
    """The answer about the step at which that became known may say otherwise."""
    camera = Camera(cart_pole())
    play(RewardModelWrapper(camera, client, TASK))
    success = [float(scores(client, camera.films[0], step).success[-1]) for step in range(6)]
    early, later = next((a, b) for b in range(2, 6) for a in range(1, b) if success[a] > success[b])
    rule = SuccessRule(threshold=(success[early] + success[later]) / 2)
    env, _ = not_blocking(late, max_pending=6, terminate_on_success=rule)
    late.hold(*range(1, later))
    assert not any(env.step(PUSH_RIGHT)[2] for _ in range(later - 1))
    late.let_come(early)
    _, _, terminated, _, info = env.step(PUSH_RIGHT)
    assert terminated
    assert_close(info["reward_model"]["success"], success[later])


def test_after_an_error_delta_pays_what_was_missed(client: RewardClient, late: LateClient) -> None:
    camera = Camera(cart_pole())
    env = RewardModelWrapper(camera, late, TASK, RewardOptions(mode="delta"))
    env.reset(seed=0)
    late.hold(1)
    late.connection.held[2].set_exception(ServerUnavailableError("the server is restarting"))
    with pytest.raises(ServerUnavailableError, match=r"^the server is restarting \(request \w+-\d+\)$"):
        env.step(PUSH_RIGHT)
    reward = env.step(PUSH_RIGHT)[1]
    first, _, newest = progress(client, camera.films[0], range(3))
    assert_close(reward, newest - first)


# Vector environments


def vector_env(env_fns: Sequence[Callable[[], gym.Env[Any, Any]]], mode: AutoresetMode) -> SyncVectorEnv:
    return SyncVectorEnv(env_fns, autoreset_mode=mode)


Steps = list[tuple[Any, ...]]


def roll(env: Any, mode: AutoresetMode, steps: int = 24) -> Steps:
    """What each step gives, and each reset; both poles fall twice, not at the same time. The first is reset in any mode."""
    told: Steps = [env.reset(seed=[0, 1])]
    num_ended = 0
    for _ in range(steps):
        told.append(env.step(np.array([0, 1])))
        ended = told[-1][2] | told[-1][3]
        if ended.any() and (mode is AutoresetMode.DISABLED or not num_ended):
            told.append(env.reset(seed=[3, 4], options={"reset_mask": ended}))
        num_ended += ended.sum()
    assert num_ended >= 4
    return told


def assert_same_steps(left: Any, right: Any, where: str = "") -> None:
    """Also of infos, masks included; where the mask says there is nothing, nothing is compared."""
    if isinstance(left, dict):
        assert left.keys() == right.keys(), where
        for key in left:
            assert_same_steps(left[key], right[key], f"{where}.{key}")
    elif isinstance(left, tuple | list):
        assert len(left) == len(right), where
        for index, (a, b) in enumerate(zip(left, right, strict=True)):
            assert_same_steps(a, b, f"{where}[{index}]")
    elif isinstance(left, np.ndarray) and left.dtype == object:
        assert_same_steps(left.tolist(), right.tolist(), where)
    elif left is None:
        assert right is None, where
    else:
        np.testing.assert_allclose(left, right, rtol=0, atol=TOLERANCE, err_msg=where)
        assert np.asarray(left).dtype == np.asarray(right).dtype, where


@pytest.mark.parametrize("reward_mode", ["absolute", "delta"])
@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.name)
def test_a_vector_is_paid_as_its_environments_would_be(
    client: RewardClient, mode: AutoresetMode, reward_mode: Any
) -> None:
    options = RewardOptions(mode=reward_mode, every=2, frames_from="pixels")
    tasks = [TASK, "let the pole fall"]
    singles = [
        partial(lambda task: RewardModelWrapper(cart_pole_with_pixels(), client, task, options), task) for task in tasks
    ]
    vector = RewardModelVectorWrapper(vector_env([cart_pole_with_pixels] * 2, mode), client, tasks, options)
    left, right = roll(vector, mode), roll(vector_env(singles, mode), mode)
    assert_same_steps(left, right)


def test_a_vector_of_processes_is_paid_as_one_in_this_process(client: RewardClient) -> None:
    def env_fn() -> gym.Env[Any, Any]:
        env = gym.make("CartPole-v1", render_mode="rgb_array")
        env.unwrapped.screen_width, env.unwrapped.screen_height = SIZE  # type: ignore[attr-defined]
        return gym.wrappers.AddRenderObservation(env, render_only=False, render_key="pixels", obs_key="state")

    mode = AutoresetMode.SAME_STEP
    left, right = (
        RewardModelVectorWrapper(envs, client, TASK, RewardOptions(frames_from="pixels", every=4, max_frames=3))
        for envs in (AsyncVectorEnv([env_fn] * 2, context="spawn", autoreset_mode=mode), vector_env([env_fn] * 2, mode))
    )
    assert_same_steps(roll(left, mode), roll(right, mode))
    left.close()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED], ids=lambda mode: mode.name)
@pytest.mark.parametrize("blocking", [True, False])
def test_a_vector_s_rendered_frames_are_scored(client: RewardClient, mode: AutoresetMode, blocking: bool) -> None:
    cameras = [Camera(cart_pole()), Camera(cart_pole())]
    envs = vector_env([lambda: cameras[0], lambda: cameras[1]], mode)
    options = RewardOptions(mode="delta", blocking=blocking)
    env = RewardModelVectorWrapper(envs, client, TASK, options)
    paid: list[list[float]] = [[], []]
    told = roll(env, mode)
    for step in told:
        if len(step) == 5:
            for index in range(2):
                if step[4]["reward_model"]["_env_reward"][index]:
                    paid[index].append(step[1][index])
                else:
                    assert step[1][index] == 0
    for index, camera in enumerate(cameras):
        lengths = [len(film) - 1 for film in camera.films]
        ends = np.cumsum(lengths)
        for film, end, length in zip(camera.films[:-1], ends, lengths, strict=False):
            values = progress(client, film, range(length + 1))
            rewards = paid[index][end - length : end]
            if blocking:
                assert_close(rewards, np.diff(values))
            assert_close(sum(rewards), values[-1] - values[0])
    env.close()


def test_a_reset_of_a_vector_takes_back_what_is_open_about_what_it_resets(late: LateClient) -> None:
    envs = vector_env([cart_pole] * 2, AutoresetMode.DISABLED)
    env = RewardModelVectorWrapper(envs, late, [TASK, "let the pole fall"], RewardOptions(blocking=False))
    env.reset(seed=0)
    late.hold(1)
    env.step(np.array([0, 1]))
    env.reset(seed=0, options={"reset_mask": np.array([False, True])})
    assert [answer.cancelled() for answer in late.submitted] == [False, True]
    env.close()
    assert [answer.cancelled() for answer in late.submitted] == [True, True]


def test_the_questions_of_a_step_go_in_one_request(late: LateClient) -> None:
    env = RewardModelVectorWrapper(vector_env([cart_pole] * 3, AutoresetMode.NEXT_STEP), late, TASK)
    env.reset(seed=0)
    env.step(np.array([0, 1, 0]))
    assert late.connection.lengths == [1, 2]


def test_success_ends_an_episode_of_a_vector_that_the_caller_resets(client: RewardClient) -> None:
    envs = vector_env([cart_pole] * 2, AutoresetMode.DISABLED)
    options = RewardOptions(every=2, terminate_on_success=SuccessRule(threshold=0.0))
    env = RewardModelVectorWrapper(envs, client, TASK, options)
    env.reset(seed=0)
    actions = np.array([0, 1])
    assert [env.step(actions)[2].tolist() for _ in range(2)] == [[False, False], [True, True]]
    infos = env.reset(options={"reset_mask": np.array([True, False])})[1]
    assert infos["reward_model"]["_progress"].tolist() == [True, False]
    assert env.step(actions)[2].tolist() == [False, True]
    infos = env.step(actions)[4]["reward_model"]
    assert infos["step"].tolist() == [2, 4]


REFUSED_VECTORS: dict[str, tuple[AutoresetMode, dict[str, Any], str]] = {
    "rendered, SAME_STEP": (
        AutoresetMode.SAME_STEP,
        {},
        r"^autoreset_mode: expected NEXT_STEP or DISABLED with frames from render\(\), .* got SAME_STEP; wrap each",
    ),
    "success, NEXT_STEP": (
        AutoresetMode.NEXT_STEP,
        {"terminate_on_success": SuccessRule()},
        "^autoreset_mode: expected DISABLED with terminate_on_success, got NEXT_STEP; wrap each environment",
    ),
}


@pytest.mark.parametrize(("mode", "options", "message"), REFUSED_VECTORS.values(), ids=REFUSED_VECTORS)
def test_what_cannot_be_right_in_a_vector_is_refused(
    client: RewardClient, mode: AutoresetMode, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        RewardModelVectorWrapper(vector_env([cart_pole] * 2, mode), client, TASK, RewardOptions(**options))


def test_a_vector_needs_a_task_for_each(client: RewardClient) -> None:
    with pytest.raises(ValueError, match=r"^task: expected one for each of the 2 environments, got 3$"):
        RewardModelVectorWrapper(vector_env([cart_pole] * 2, AutoresetMode.DISABLED), client, [TASK] * 3)


def test_an_error_tells_which_environment_of_the_vector_it_is_about(client: RewardClient) -> None:
    env = RewardModelVectorWrapper(vector_env([cart_pole] * 2, AutoresetMode.DISABLED), client, [TASK, "lift " * 50])
    with pytest.raises(InvalidSampleError, match=r"^envs\[1\]\.task: expected at most 32 tokens"):
        env.reset()


def test_wrapped_environments_work_in_processes_of_their_own(served: Served, client: RewardClient) -> None:
    connect = partial(RewardClient, served.url("grpc"), model=MODEL)
    options = RewardOptions(max_frames=4)

    def env_fn() -> gym.Env[Any, Any]:
        env = gym.make("CartPole-v1", render_mode="rgb_array")
        return RewardModelWrapper(env, connect, "balance the pole", options)

    env = AsyncVectorEnv([env_fn] * 2, context="spawn")
    env.reset(seed=[5, 6])
    frames = [[frame] for frame in env.render()]
    for _ in range(2):
        rewards = env.step(np.array([0, 1]))[1]
        for film, frame in zip(frames, env.render(), strict=True):
            film.append(frame)
    env.close()
    assert_close(rewards, [progress(client, film, [2])[0] for film in frames])


# What is closed, and what is imported


def test_close_closes_only_the_client_that_it_made(served: Served, client: RewardClient) -> None:
    made: list[RewardClient] = []

    def connect() -> RewardClient:
        made.append(served.client("grpc", MODEL))
        return made[-1]

    env = RewardModelWrapper(cart_pole(), connect, TASK)
    assert made == []
    env.reset()
    for _ in range(2):
        env.close()
    with pytest.raises(RuntimeError, match="closed"):
        made[0].is_ready()
    env = RewardModelWrapper(cart_pole(), client, TASK)
    env.reset()
    env.close()
    assert client.is_ready()
    assert len(made) == 1


def test_the_client_does_not_need_gymnasium() -> None:
    check = "import sys, rfm_client; print('gymnasium' in sys.modules); sys.modules['gymnasium'] = None; import rfm_client.gym"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True)
    assert done.stdout == "False\n"
    assert done.stderr.strip().endswith(
        'ImportError: rfm_client.gym needs gymnasium >= 1.1: pip install "./client[gym]"'
    )
