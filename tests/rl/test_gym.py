# SPDX-License-Identifier: MIT
"""Rewards for a Gymnasium environment, with and without waiting for answers."""

from __future__ import annotations

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
    TASK,
    Camera,
    LateClient,
    assert_close,
    cart_pole,
    cart_pole_with_pixels,
    play,
    play_on,
    progress,
    scores,
    two_cameras,
)
from rfm_client import InvalidSampleError, RewardClient, ServerUnavailableError
from rfm_rl import RewardModelWrapper, RewardOptions, SuccessRule
from servers import Served


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"mode": "delta"},
        {"scale": 10.0, "add_to_env_reward": True},
        {"every": 3},
        {"every": 3, "mode": "delta"},
        {"max_frames": 3},
    ],
    ids=str,
)
def test_each_step_is_paid_by_the_scores_of_its_episode(client: RewardClient, options: dict[str, Any]) -> None:
    camera = Camera(cart_pole())
    env = RewardModelWrapper(camera, client, TASK, RewardOptions(**options))
    every, max_frames = options.get("every", 1), options.get("max_frames", MAX_FRAMES)
    for seed in range(2):
        rewards, infos = play(env, seed)
        video, last = camera.videos[seed], len(rewards)
        assert last >= 8
        assert every == 1 or seed or last % every != 0  # the last step is scored nevertheless
        newest = [step if step == last else step - step % every for step in range(last + 1)]
        answers = {step: scores(client, video, step, max_frames) for step in newest}
        values = np.array([answers[step].progress[-1] for step in newest])
        expected = np.diff(values) if options.get("mode") == "delta" else values[1:]
        assert_close(rewards, options.get("scale", 1) * expected + options.get("add_to_env_reward", False))
        for step, (known, info) in enumerate(zip(newest, infos, strict=True)):
            told = info["reward_model"]
            assert_close([told["progress"], told["success"]], [answers[known].progress[-1], answers[known].success[-1]])
            assert (told["step"], told["lag"], told["skipped"]) == (known, step - known, 0)
            np.testing.assert_equal(told["env_reward"], 1.0 if step else np.nan)


def test_an_episode_ends_where_most_of_the_last_frames_succeed(client: RewardClient) -> None:
    camera = Camera(cart_pole())
    play(RewardModelWrapper(camera, client, TASK))
    video = camera.videos[0]
    successes = [scores(client, video, step).success for step in range(len(video))]
    threshold = float(np.median([np.median(success[-3:]) for success in successes[1:]]))
    votes = [np.mean(success[-3:] >= threshold) > 0.5 for success in successes]
    expected = votes.index(True, 1)
    env = RewardModelWrapper(cart_pole(), client, TASK, RewardOptions(terminate_on_success=SuccessRule(threshold, 3)))
    rewards, _ = play(env)
    assert len(rewards) == expected < len(video) - 1


@pytest.mark.parametrize(("threshold", "every", "steps"), [(0.0, 1, 1), (0.0, 4, 4), (1.0, 1, 8)])
def test_only_a_scored_step_can_succeed(client: RewardClient, threshold: float, every: int, steps: int) -> None:
    options = RewardOptions(every=every, terminate_on_success=SuccessRule(threshold))
    rewards, _ = play(RewardModelWrapper(cart_pole(), client, TASK, options))
    assert len(rewards) == steps


def test_gymnasium_s_own_check_passes_and_close_closes_only_a_client_that_it_made(served: Served) -> None:
    made: list[RewardClient] = []

    def connect() -> RewardClient:
        made.append(served.client("grpc", MODEL))
        return made[-1]

    env = RewardModelWrapper(cart_pole(), connect, TASK)
    assert made == []
    with pytest.warns(UserWarning) as warnings:
        check_env(env, skip_render_check=True, skip_close_check=True)  # which would make it anew from the name
    assert all("different from the unwrapped" in str(w.message) or "infinity" in str(w.message) for w in warnings)
    spec = RecordEpisodeStatistics(env).spec  # outer wrappers may ask for it
    assert spec is not None
    assert spec.id == "CartPole-v1"
    for _ in range(2):
        env.close()
    (client,) = made
    with pytest.raises(RuntimeError, match="closed"):
        client.is_ready()
    with served.client("grpc", MODEL) as own:
        RewardModelWrapper(cart_pole(), own, TASK).close()
        assert own.is_ready()


@pytest.mark.parametrize(("fuse", "blocking"), [("mean", True), ("min", False)])
def test_several_cameras_are_scored_apart_and_fused(client: RewardClient, fuse: Any, blocking: bool) -> None:
    options = RewardOptions(frames_from=two_cameras, cameras=["wrist", "front"], fuse=fuse, blocking=blocking)
    env = RewardModelWrapper(cart_pole_with_pixels(), client, TASK, options)
    observation, info = env.reset(seed=0)
    video, ended, rewards = [two_cameras(observation)], False, []
    while not ended:
        observation, reward, ended, _, info = env.step(PUSH_RIGHT)
        video.append(two_cameras(observation))
        rewards.append(reward)
    steps = list(range(1, len(video)))
    of_cameras = [progress(client, [shown[name] for shown in video], steps) for name in ("front", "wrist")]
    expected = getattr(np, fuse)(of_cameras, axis=0)
    assert info["reward_model"]["step"] == steps[-1]  # the last is waited for
    assert_close(rewards if blocking else rewards[-1], expected if blocking else expected[-1])


REFUSED_OPTIONS: dict[str, tuple[dict[str, Any], str]] = {
    "mode": ({"mode": "relative"}, "^mode: expected one of absolute, delta, shaping, final, got 'relative'$"),
    "cameras": ({"cameras": ["front"]}, r"^cameras: expected keys of the observation \[\], got \['front'\]$"),
    "fuse": ({"fuse": "sum"}, "^fuse: expected one of mean, min, max, got 'sum'$"),
    "orient": ({"orient": "upside-down"}, "^orient: expected one of none, rotate180, .*, got 'upside-down'$"),
    "orient of a camera": (
        {"orient": {"front": "rotate180"}},
        "^orient: expected one for all frames, .*, got 'front'$",
    ),
    "channels": ({"channels": "gbr"}, "^channels: expected one of rgb, bgr, got 'gbr'$"),
    "channels of a camera": (
        {"channels": {"front": "bgr"}},
        "^channels: expected one for all frames, .*, got 'front'$",
    ),
    "frames_from": ({"frames_from": "pixels"}, r"^frames_from: expected a key of the observation \[\], got 'pixels'$"),
    "render_mode": ({}, r"^render_mode: expected 'rgb_array', .* got None$"),
}


@pytest.mark.parametrize(("options", "message"), REFUSED_OPTIONS.values(), ids=REFUSED_OPTIONS)
def test_options_that_cannot_be_right_are_refused(options: dict[str, Any], message: str) -> None:
    env = cart_pole() if options else gym.make("CartPole-v1")
    with RewardClient("grpc://127.0.0.1:1") as client, pytest.raises(ValueError, match=message):
        RewardModelWrapper(env, client, TASK, RewardOptions(**options))


REFUSED_FRAMES: dict[str, tuple[dict[str, Any], str]] = {
    "none": ({"frames_from": lambda seen: seen["state"]}, r"^frame: expected uint8 \[H, W, 3\], got float32 \[4\]$"),
    "a camera is missing": (
        {"frames_from": two_cameras, "cameras": ["front", "top"]},
        r"^frames: expected a frame of each of the cameras \['front', 'top'\], got \['front', 'wrist', 'state'\]$",
    ),
    "no cameras": ({"frames_from": "pixels", "cameras": ["front"]}, r"the cameras \['front'\], got ndarray$"),
}


@pytest.mark.parametrize(("options", "message"), REFUSED_FRAMES.values(), ids=REFUSED_FRAMES)
def test_an_observation_without_the_frame_is_refused(options: dict[str, Any], message: str) -> None:
    with RewardClient("grpc://127.0.0.1:1") as client:
        env = RewardModelWrapper(cart_pole_with_pixels(), client, TASK, RewardOptions(**options))
        with pytest.raises(InvalidSampleError, match=message):
            env.reset()


# Steps that do not wait: the test lets answers come when it wants.


def not_blocking(late: LateClient, **options: Any) -> tuple[RewardModelWrapper, Camera]:
    camera = Camera(cart_pole())
    env = RewardModelWrapper(camera, late, TASK, RewardOptions(sampling="all", blocking=False, **options))
    env.reset(seed=0)
    return env, camera


# Answers that arrive after each step, and the newest in use at the next.
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
    values = progress(client, camera.videos[0], [0, *newest], None)
    assert_close(rewards, values[1:] if mode == "absolute" else np.diff(values))
    expected = [(known, step - known, 0) for step, known in enumerate(newest, 1)]
    assert [(each["step"], each["lag"], each["skipped"]) for each in told] == expected
    env.close()


def test_with_too_many_questions_open_a_step_is_skipped_and_counted_until_a_reset(
    client: RewardClient, late: LateClient
) -> None:
    env, camera = not_blocking(late, max_pending=2)
    late.hold(1, 2, 5)
    skipped = [env.step(PUSH_RIGHT)[4]["reward_model"]["skipped"] for _ in range(4)]
    assert skipped == [0, 0, 1, 2]
    late.let_come(1, 2)
    told = env.step(PUSH_RIGHT)[4]["reward_model"]
    assert (told["step"], told["lag"], told["skipped"]) == (2, 3, 2)
    assert sorted(late.answers) == [1, 2, 5]
    env.reset(seed=1)
    assert late.answers[5].cancelled()
    late.hold(1)
    _, reward, _, _, info = env.step(PUSH_RIGHT)
    assert (info["reward_model"]["step"], info["reward_model"]["skipped"]) == (0, 0)
    assert_close(reward, progress(client, camera.videos[1], [0], None))
    env.close()


@pytest.mark.parametrize("await_last", [True, False])
def test_the_last_step_waits_so_that_late_rewards_add_up_unless_it_shall_not(
    client: RewardClient, late: LateClient, await_last: bool
) -> None:
    env, camera = not_blocking(late, mode="delta", max_pending=2, await_last=await_last)
    late.hold(1, 2, 3)
    env.step(PUSH_RIGHT)
    late.let_come(1)
    rewards, infos = play_on(env)
    last = 1 + len(rewards)
    known = last if await_last else 1
    first, second, newest = progress(client, camera.videos[0], [0, 1, known], None)
    assert_close(rewards, [second - first, *[0] * (last - 3), newest - second])
    told = infos[-1]["reward_model"]
    assert (told["step"], told["lag"], told["skipped"]) == (known, last - known, last - 4)
    assert {step: answer.cancelled() for step, answer in late.answers.items()} == {1: False, 2: True, 3: True}


def test_an_episode_ends_at_the_step_at_which_success_is_known_and_stays_a_success(
    client: RewardClient, late: LateClient
) -> None:
    """The awaited answer about that step may differ."""
    camera = Camera(cart_pole())
    play(RewardModelWrapper(camera, client, TASK))
    success = [float(scores(client, camera.videos[0], step, None).success[-1]) for step in range(6)]
    early, later = next((a, b) for b in range(2, 6) for a in range(1, b) if success[a] > success[b])
    rule = SuccessRule(threshold=(success[early] + success[later]) / 2)
    env, camera = not_blocking(late, max_pending=6, terminate_on_success=rule)
    late.hold(*range(1, later))
    assert not any(env.step(PUSH_RIGHT)[2] for _ in range(later - 1))
    late.let_come(early)
    _, reward, terminated, truncated, info = env.step(PUSH_RIGHT)
    told = info["reward_model"]
    assert (terminated, truncated, told["succeeded"], told["step"]) == (True, False, True, later)
    assert_close(told["success"], success[later])
    assert_close(reward, progress(client, camera.videos[0], [later], None))


def test_after_an_error_delta_pays_what_was_missed(client: RewardClient, late: LateClient) -> None:
    camera = Camera(cart_pole())
    env = RewardModelWrapper(camera, late, TASK, RewardOptions(sampling="all", mode="delta"))
    env.reset(seed=0)
    late.hold(1)
    late.connection.held[2].set_exception(ServerUnavailableError("the server is restarting"))
    with pytest.raises(ServerUnavailableError, match=r"^the server is restarting \(request \w+-\d+\)$"):
        env.step(PUSH_RIGHT)
    reward = env.step(PUSH_RIGHT)[1]
    first, _, newest = progress(client, camera.videos[0], range(3), None)
    assert_close(reward, newest - first)


def test_an_error_comes_out_at_the_latest_where_the_episode_ends(client: RewardClient) -> None:
    steps = MAX_FRAMES + 4
    options = RewardOptions(sampling="all", blocking=False, max_pending=steps)
    env = RewardModelWrapper(cart_pole(max_episode_steps=steps), client, TASK, options)
    env.reset(seed=0)
    with pytest.raises(InvalidSampleError, match=f"^num_frames: expected at most {MAX_FRAMES} .*, got"):
        for step in range(steps):
            env.step(step % 2)
