# SPDX-License-Identifier: MIT
"""Steps that do not wait for their rewards."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from environments import (
    PUSH_RIGHT,
    TASK,
    Camera,
    LateClient,
    assert_close,
    cart_pole,
    play,
    play_on,
    progress,
    scores,
)
from rfm_client import (
    RewardClient,
    ServerUnavailableError,
)
from rfm_client.gym import RewardModelWrapper, RewardOptions, SuccessRule


def not_blocking(late: LateClient, **options: Any) -> tuple[RewardModelWrapper, Camera]:
    camera = Camera(cart_pole())
    env = RewardModelWrapper(camera, late, TASK, RewardOptions(sampling="all", blocking=False, **options))
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
    values = progress(client, camera.films[0], [0, *newest], None)
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
    first_and_last = progress(client, camera.films[0], [0, last], None)
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
    values = progress(client, camera.films[0], [0, 1], None)
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
    assert_close(reward, progress(client, camera.films[1], [0], None))


def test_success_ends_the_episode_at_the_step_at_which_it_is_known(client: RewardClient, late: LateClient) -> None:
    env, camera = not_blocking(late, terminate_on_success=SuccessRule(threshold=0.0))
    late.hold(1, 2)
    assert [env.step(PUSH_RIGHT)[2] for _ in range(2)] == [False, False]
    late.let_come(1)
    _, reward, terminated, truncated, info = env.step(PUSH_RIGHT)
    assert (terminated, truncated, info["reward_model"]["step"]) == (True, False, 3)
    assert info["reward_model"]["succeeded"]
    assert_close(reward, progress(client, camera.films[0], [3], None))


def test_an_episode_that_has_succeeded_stays_so(client: RewardClient, late: LateClient) -> None:
    """The answer about the step at which that became known may say otherwise."""
    camera = Camera(cart_pole())
    play(RewardModelWrapper(camera, client, TASK))
    success = [float(scores(client, camera.films[0], step, None).success[-1]) for step in range(6)]
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
    env = RewardModelWrapper(camera, late, TASK, RewardOptions(sampling="all", mode="delta"))
    env.reset(seed=0)
    late.hold(1)
    late.connection.held[2].set_exception(ServerUnavailableError("the server is restarting"))
    with pytest.raises(ServerUnavailableError, match=r"^the server is restarting \(request \w+-\d+\)$"):
        env.step(PUSH_RIGHT)
    reward = env.step(PUSH_RIGHT)[1]
    first, _, newest = progress(client, camera.films[0], range(3), None)
    assert_close(reward, newest - first)
