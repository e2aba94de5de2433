# SPDX-License-Identifier: MIT
"""Rewards for a Gymnasium environment, with and without waiting for answers of a real server."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import Autoreset, RecordEpisodeStatistics, TimeLimit

from coded_env import CodedEnv, Recorder, frame_of
from environments import MAX_FRAMES, MODEL, TASK, LateClient, assert_close, cart_pole, play, play_on, progress, scores
from paths import ROOT
from recordings import logged
from rfm_client import InvalidSampleError, RewardClient
from rfm_rl import RewardModelWrapper, RewardOptions, SuccessRule
from servers import Served

TASKS = ["task 0", "task 1"]
LENGTH = 8  # steps of an episode
VIDEO = [frame_of(0, 0, step) for step in range(LENGTH + 1)]


def options(**more: Any) -> RewardOptions:
    return RewardOptions(sampling="all", frames_from="pixels", **more)


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


def test_the_loop_of_the_guide_logs_the_scores_for_rerun(
    client: RewardClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    guide = (ROOT / "docs" / "guides" / "reward_an_rl_loop.md").read_text()
    (loop,) = (code for code in re.findall(r"^```py\n(.*?)^```", guide, re.M | re.S) if "log(" in code)
    ((init, save),) = re.findall(r"# Rerun .*, after (.*) and (.*)", loop)
    steps = range(LENGTH)
    of_rerun = re.sub(r".*# (W&B|TensorBoard).*\n", "", loop).replace("range(1000)", str(steps))
    code = f"{init}\n{save}\n{of_rerun}rerun.disconnect()"
    monkeypatch.chdir(tmp_path)
    exec(code, {"rerun": rerun, "env": RewardModelWrapper(CodedEnv(0, (LENGTH,)), client, TASK, options())})
    for key in ("progress", "reward"):
        times, values = logged(tmp_path / "pole.rrd", "step", f"/reward_model/{key}", "Scalar")
        assert times == list(steps)
        assert_close(values, progress(client, VIDEO, [step + 1 for step in steps], None))


# Steps that do not wait: the test lets answers come when it wants.


def not_blocking(late: LateClient, **more: Any) -> RewardModelWrapper:
    env = RewardModelWrapper(CodedEnv(0, (LENGTH,)), late, TASK, options(blocking=False, **more))
    env.reset()
    return env


# Answers that arrive after each step, and the newest in use at the next.
COMING: list[tuple[tuple[int, ...], int]] = [((), 0), ((), 0), ((2,), 2), ((1,), 2), ((3, 4), 4), ((), 4)]


@pytest.mark.parametrize("mode", ["absolute", "delta"])
def test_a_step_goes_on_with_the_newest_answer_that_has_come(client: RewardClient, late: LateClient, mode: Any) -> None:
    env = not_blocking(late, mode=mode, max_pending=6)
    late.hold(*range(1, 7))
    rewards, told = [], []
    for come, _ in COMING:
        late.let_come(*come)
        _, reward, _, _, info = env.step(0)
        rewards.append(reward)
        told.append(info["reward_model"])
    newest = [step for _, step in COMING]
    values = progress(client, VIDEO, [0, *newest], None)
    assert_close(rewards, values[1:] if mode == "absolute" else np.diff(values))
    expected = [(known, step - known, 0) for step, known in enumerate(newest, 1)]
    assert [(each["step"], each["lag"], each["skipped"]) for each in told] == expected
    env.close()


def test_with_too_many_questions_open_a_step_is_skipped_and_counted_until_a_reset(late: LateClient) -> None:
    env = not_blocking(late, max_pending=2)
    late.hold(1, 2, 5)
    skipped = [env.step(0)[4]["reward_model"]["skipped"] for _ in range(4)]
    assert skipped == [0, 0, 1, 2]
    late.let_come(1, 2)
    told = env.step(0)[4]["reward_model"]
    assert (told["step"], told["lag"], told["skipped"]) == (2, 3, 2)
    assert sorted(late.answers) == [1, 2, 5]
    env.reset()
    assert late.answers[5].cancelled()
    late.hold(1)
    told = env.step(0)[4]["reward_model"]
    assert (told["step"], told["skipped"]) == (0, 0)
    env.close()


def test_the_last_step_waits_so_that_late_rewards_add_up(client: RewardClient, late: LateClient) -> None:
    env = not_blocking(late, mode="delta", max_pending=2)
    late.hold(1, 2, 3)
    env.step(0)
    late.let_come(1)
    rewards, infos = play_on(env)
    first, second, newest = progress(client, VIDEO, [0, 1, LENGTH], None)
    assert_close(rewards, [second - first, *[0] * (LENGTH - 3), newest - second])
    told = infos[-1]["reward_model"]
    assert (told["step"], told["lag"], told["skipped"]) == (LENGTH, 0, LENGTH - 4)
    assert {step: answer.cancelled() for step, answer in late.answers.items()} == {1: False, 2: True, 3: True}


def test_an_episode_ends_at_the_step_at_which_success_is_known_and_stays_a_success(
    client: RewardClient, late: LateClient
) -> None:
    """The awaited answer about that step may differ."""
    success = [float(scores(client, VIDEO, step, None).success[-1]) for step in range(6)]
    early, later = next((a, b) for b in range(2, 6) for a in range(1, b) if success[a] > success[b])
    rule = SuccessRule(threshold=(success[early] + success[later]) / 2)
    env = not_blocking(late, max_pending=6, terminate_on_success=rule)
    late.hold(*range(1, later))
    assert not any(env.step(0)[2] for _ in range(later - 1))
    late.let_come(early)
    _, reward, terminated, truncated, info = env.step(0)
    told = info["reward_model"]
    assert (terminated, truncated, told["succeeded"], told["step"]) == (True, False, True, later)
    assert_close(told["success"], success[later])
    assert_close(reward, progress(client, VIDEO, [later], None))


def test_an_error_comes_out_at_the_latest_where_the_episode_ends(client: RewardClient) -> None:
    env = RewardModelWrapper(
        CodedEnv(0, (MAX_FRAMES + 4,)), client, TASK, options(blocking=False, max_pending=MAX_FRAMES + 4)
    )
    with pytest.raises(InvalidSampleError, match=f"^num_frames: expected at most {MAX_FRAMES} .*, got"):
        play(env)


# Gymnasium's Autoreset.


def test_an_autoreset_outside_begins_an_episode_after_each_end_and_one_inside_is_refused(recorder: Recorder) -> None:
    """One inside would not learn of an end by success."""
    coded, tasks = CodedEnv(), iter(TASKS)
    succeeds = options(terminate_on_success=SuccessRule(threshold=0.0))
    with pytest.raises(ValueError, match=r"^env: expected no Autoreset inside, got one; wrap in the other order"):
        RewardModelWrapper(TimeLimit(Autoreset(coded), 9), recorder, TASK, succeeds)
    env = Autoreset(RewardModelWrapper(coded, recorder, lambda info: next(tasks), succeeds))
    env.reset()
    assert env.step(0)[2]
    _, reward, *_, info = env.step(0)
    assert (reward, info["reward_model"]["step"]) == (0, 0)
    assert recorder.calls[-1] == [([(0, 1, 0)], TASKS[1])]
