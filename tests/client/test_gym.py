# SPDX-License-Identifier: MIT
"""Rewards for one Gymnasium environment."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordEpisodeStatistics

from environments import (
    MAX_FRAMES,
    MODEL,
    PUSH_RIGHT,
    SIZE,
    TASK,
    Camera,
    assert_close,
    cart_pole,
    cart_pole_with_pixels,
    play,
    progress,
    scores,
    two_cameras,
)
from reference_server import Served
from rfm_client import (
    InvalidSampleError,
    ModelNotFoundError,
    RewardClient,
    Trajectory,
)
from rfm_client.contract.samples import UInt8Array
from rfm_client.gym import RewardModelWrapper, RewardOptions, SuccessRule


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
    frames = np.repeat(np.array(env.render())[np.newaxis], MAX_FRAMES, axis=0)
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


@pytest.mark.parametrize("blocking", [True, False])
@pytest.mark.parametrize("fuse", ["mean", "min", "max"])
def test_several_cameras_are_scored_apart_and_fused(client: RewardClient, fuse: Any, blocking: bool) -> None:
    options = RewardOptions(frames_from=two_cameras, cameras=["wrist", "front"], fuse=fuse, blocking=blocking)
    env = RewardModelWrapper(cart_pole_with_pixels(), client, TASK, options)
    observation, info = env.reset(seed=0)
    film, ended, rewards = [two_cameras(observation)], False, []
    while not ended:
        observation, reward, ended, _, info = env.step(PUSH_RIGHT)
        film.append(two_cameras(observation))
        rewards.append(reward)
    steps = list(range(1, len(film)))
    of_cameras = [progress(client, [shown[name] for shown in film], steps) for name in ("front", "wrist")]
    expected = getattr(np, fuse)(of_cameras, axis=0)
    assert info["reward_model"]["step"] == steps[-1]  # the last is waited for
    assert_close(rewards if blocking else rewards[-1], expected if blocking else expected[-1])


def test_cameras_may_be_keys_of_the_observation(client: RewardClient) -> None:
    env = RewardModelWrapper(cart_pole_with_pixels(), client, TASK, RewardOptions(cameras=["pixels"]))
    observation, info = env.reset(seed=0)
    assert_close(info["reward_model"]["progress"], progress(client, [observation["pixels"]], [0])[0])


def test_a_camera_that_shows_nothing_is_told(client: RewardClient) -> None:
    options = RewardOptions(frames_from=two_cameras, cameras=["front", "top"])
    expected = r"^frames: expected a frame of each of the cameras \['front', 'top'\], got \['front', 'wrist'\]$"
    with pytest.raises(InvalidSampleError, match=expected):
        RewardModelWrapper(cart_pole_with_pixels(), client, TASK, options).reset()
    options = RewardOptions(frames_from="pixels", cameras=["front"])
    with pytest.raises(InvalidSampleError, match=r"the cameras \['front'\], got ndarray$"):
        RewardModelWrapper(cart_pole_with_pixels(), client, TASK, options).reset()


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
    "cameras": ({"cameras": ["front"]}, r"^cameras: expected keys of the observation \[\], got \['front'\]$"),
    "a camera": ({"cameras": "front"}, "^cameras: expected a sequence of names, got 'front'$"),
    "fuse": ({"fuse": "sum"}, "^fuse: expected one of mean, min, max, got 'sum'$"),
    "orient": ({"orient": "upside-down"}, "^orient: expected one of none, rotate180, .*, got 'upside-down'$"),
    "orient of a camera": ({"orient": {"front": "rotate180"}}, "^orient: expected one orientation, .*, got 'front'$"),
    "scale": ({"scale": float("nan")}, "^scale: expected a number, got nan$"),
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
    options = RewardOptions(sampling="all", blocking=blocking, max_pending=steps)
    env = RewardModelWrapper(cart_pole(max_episode_steps=steps), client, TASK, options)
    env.reset(seed=0)
    with pytest.raises(InvalidSampleError, match=f"^num_frames: expected at most {MAX_FRAMES} .*, got"):
        for step in range(1, steps + 1):
            env.step(step % 2)
    assert step == MAX_FRAMES if blocking else step >= MAX_FRAMES
