# SPDX-License-Identifier: MIT
"""The frames that the Gymnasium wrappers send; each encodes environment, episode and step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, nullcontext
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import Autoreset, TimeLimit

from coded_env import Code, CodedEnv, Recorder, frame_of
from rfm_client import InvalidSampleError, ServerUnavailableError
from rfm_rl import RewardModelVectorWrapper, RewardModelWrapper, RewardOptions, SuccessRule

LENGTHS = (3,), (4, 1, 2)  # steps of the episodes by environment, in turn
TASKS = ["task 0", "task 1"]
ACTIONS = np.zeros(2, int)
NEXT_STEP, SAME_STEP, DISABLED = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED
ASKED = {  # by environment: episode and step of each call, first the reset; some ask about two or none
    NEXT_STEP: ("0.0 0.1 0.2 0.3 1.0 1.1 1.2 1.3 2.0 2.1", "0.0 0.1 0.2 0.3 0.4 1.0 1.1 2.0 2.1 2.2"),
    SAME_STEP: (
        "0.0 0.1 0.2 0.3+1.0 1.1 1.2 1.3+2.0 2.1 2.2 2.3+3.0",
        "0.0 0.1 0.2 0.3 0.4+1.0 1.1+2.0 2.1 2.2+3.0 3.1 3.2",
    ),
    DISABLED: ("0.0 0.1 0.2 0.3 1.0 1.1 - 1.2 - 1.3", "0.0 0.1 0.2 0.3 - 0.4 1.0 1.1 2.0 2.1"),
}
CALLS = 10

CANVAS = CodedEnv().canvas


def drawn(observation: Any) -> Any:
    """Return the frame of an observation; all environments draw into the same array."""
    CANVAS[:] = observation["pixels"]
    return CANVAS


SOURCES: dict[str, Any] = {"rendered": None, "a key": "pixels", "a function": drawn}
SHOWN = [
    pytest.param(SyncVectorEnv, mode, source, reuse, None, id=f"{mode.name}-{name}{'-reused' if reuse else ''}")
    for mode in AutoresetMode
    for name, source in SOURCES.items()
    for reuse in (False, True)
    if mode is not SAME_STEP or not (reuse or source is None)  # refused, see below
]
PROCESSES = [(AsyncVectorEnv, NEXT_STEP, None, True, None), (AsyncVectorEnv, SAME_STEP, "pixels", False, None)]
FAILING = [
    pytest.param(SyncVectorEnv, mode, "pixels", mode is not SAME_STEP, call, id=f"{mode.name}-fails at {call}")
    for mode in AutoresetMode
    for call in range(CALLS - 1)
]


@pytest.fixture
def recorder() -> Iterator[Recorder]:
    with Recorder() as client:
        yield client


def options(source: Any, **more: Any) -> RewardOptions:
    return RewardOptions(sampling="all", frames_from=source, **more)


def vector_of(kind: Any, mode: AutoresetMode, client: Recorder, source: Any, reuse: bool) -> RewardModelVectorWrapper:
    makers = [partial(CodedEnv, number, lengths, reuse=reuse) for number, lengths in enumerate(LENGTHS)]
    kinds = {"context": "spawn"} if kind is AsyncVectorEnv else {}
    return RewardModelVectorWrapper(kind(makers, autoreset_mode=mode, **kinds), client, TASKS, options(source))


def up_to(number: int, episode: int, step: int) -> tuple[list[Code], str]:
    """Return the question about a step: all frames of the episode so far, and the task."""
    return [(number, episode, each) for each in range(step + 1)], TASKS[number]


@pytest.mark.parametrize(("kind", "mode", "source", "reuse", "failing"), [*SHOWN, *PROCESSES, *FAILING])
def test_a_vector_sends_each_episode_s_own_frames(
    kind: Any, mode: AutoresetMode, source: Any, reuse: bool, failing: int | None
) -> None:
    """Also after a failed call, whose frame is part of the episode."""
    with Recorder(failing) as client, closing(vector_of(kind, mode, client, source, reuse)) as env:
        expected = []
        for call, asked in enumerate(zip(*map(str.split, ASKED[mode]), strict=True)):
            act: Any = partial(env.step, ACTIONS)
            if call == 0:
                act = partial(env.reset, seed=0)
            elif "-" in asked:
                with pytest.raises(ResetNeeded, match="since their episodes have ended, got another step; call reset"):
                    act()
                act = partial(env.reset, options={"reset_mask": np.array([each != "-" for each in asked])})
            with pytest.raises(ServerUnavailableError) if call == failing else nullcontext():
                act()
            codes = [(number, each) for number, each in enumerate(asked) if each != "-"]
            expected.append([up_to(n, *map(int, code.split("."))) for n, each in codes for code in each.split("+")])
    assert [sorted(call) for call in client.calls] == expected


def test_a_reset_that_draws_over_the_last_frame_is_refused(recorder: Recorder) -> None:
    message = r"^final_obs\[0\]: expected the last frame .*, got the first frame of the next .* a copy .*NEXT_STEP$"
    with closing(vector_of(SyncVectorEnv, SAME_STEP, recorder, "pixels", reuse=True)) as env:
        env.reset(seed=0)
        for _ in range(2):
            env.step(ACTIONS)
        with pytest.raises(InvalidSampleError, match=message):
            env.step(ACTIONS)
    assert all(codes == up_to(*codes[-1])[0] for call in recorder.calls for codes, _ in call)


def test_a_vector_that_does_not_tell_the_last_frame_is_refused(recorder: Recorder) -> None:
    class Silent(SyncVectorEnv):
        def step(self, actions: Any) -> Any:
            *told, _ = super().step(actions)
            return *told, {}

    env = vector_of(Silent, SAME_STEP, recorder, "pixels", reuse=False)
    env.reset(seed=0)
    for _ in range(2):
        env.step(ACTIONS)
    with pytest.raises(
        InvalidSampleError, match=r"^infos: expected final_obs of the environments \[0\], .*NEXT_STEP, or "
    ):
        env.step(ACTIONS)
    with pytest.raises(
        ResetNeeded, match=r"^step: expected a reset of the environments \[0, 1\], since an earlier call failed"
    ):
        env.step(ACTIONS)


def test_a_reset_that_workers_would_do_twice_is_refused(recorder: Recorder) -> None:
    makers = [partial(CodedEnv, number, (1,)) for number in range(2)]
    workers = AsyncVectorEnv(makers, autoreset_mode=NEXT_STEP, shared_memory=False, context="spawn")
    with closing(RewardModelVectorWrapper(workers, recorder, TASKS, options("pixels"))) as env:
        env.reset()
        env.step(ACTIONS)
        with pytest.raises(ValueError, match=r"^reset: expected none .* environments \[0, 1\], .*shared_memory=True$"):
            env.reset()
        env.step(ACTIONS)
        env.reset()
        env.step(ACTIONS)
    assert recorder.calls[-1] == [up_to(0, 2, 1), up_to(1, 2, 1)]


@pytest.mark.parametrize("failing", range(CALLS - 1))
@pytest.mark.parametrize("resets", ["by the caller", "by Autoreset below", "by Autoreset above"])
def test_an_environment_goes_on_after_a_failure_at_any_step(resets: str, failing: int) -> None:
    coded = CodedEnv(0, (3, 1), reuse=True)
    with Recorder(failing) as client:
        below = Autoreset(coded) if resets == "by Autoreset below" else coded
        env: gym.Env[Any, Any] = RewardModelWrapper(below, client, TASKS[0], options(None))
        if resets == "by Autoreset above":
            env = Autoreset(env)
        expected = []
        for call in range(CALLS):
            act: Any = partial(env.step, 0)
            if call == 0 or (coded.has_ended and resets == "by the caller"):
                act = env.reset
            elif coded.has_ended and resets == "by Autoreset above" and call == failing + 1:  # which was not told
                with pytest.raises(ResetNeeded):
                    act()
                act = env.reset
            with pytest.raises(ServerUnavailableError) if call == failing else nullcontext():
                act()
            expected.append([up_to(*coded.code)])
    assert client.calls == expected


def test_the_step_in_which_autoreset_resets_begins_an_episode_and_pays_nothing(recorder: Recorder) -> None:
    coded = CodedEnv(0, (2,))
    tasks = iter(TASKS)
    env = RewardModelWrapper(
        TimeLimit(Autoreset(coded), 9), recorder, lambda info: next(tasks), options("pixels", add_to_env_reward=True)
    )
    env.reset()
    told = [env.step(0) for _ in range(3)]
    assert [terminated for _, _, terminated, _, _ in told] == [False, True, False]
    assert told[1][1] > 1
    assert told[2][1] == 0
    assert told[2][4]["reward_model"]["step"] == 0
    assert np.isnan(told[2][4]["reward_model"]["env_reward"])
    assert recorder.calls[-1] == [([(0, 1, 0)], TASKS[1])]


def test_an_autoreset_above_begins_an_episode_after_a_success(recorder: Recorder) -> None:
    rewarded = options("pixels", add_to_env_reward=True, terminate_on_success=SuccessRule(threshold=0.0))
    env = Autoreset(RewardModelWrapper(CodedEnv(), recorder, TASKS[0], rewarded))
    env.reset()
    told = [env.step(0) for _ in range(3)]
    assert [terminated for _, _, terminated, _, _ in told] == [True, False, True]
    assert told[1][1] == 0
    assert told[1][4]["reward_model"]["step"] == 0
    assert recorder.calls == [[up_to(0, episode, step)] for episode in range(2) for step in range(2)]


ENDED: dict[str, tuple[Callable[[CodedEnv], gym.Env[Any, Any]], int, SuccessRule | None]] = {
    "terminated": (lambda env: env, 3, None),
    "truncated above Autoreset": (lambda env: TimeLimit(Autoreset(env), 1), 1, None),  # which does not learn of the end
    "succeeded": (lambda env: env, 1, SuccessRule(threshold=0.0)),
    "succeeded above Autoreset": (lambda env: Autoreset(env), 1, SuccessRule(threshold=0.0)),
}


@pytest.mark.parametrize(("wrapped", "length", "rule"), ENDED.values(), ids=ENDED)
def test_a_step_after_the_end_is_refused(
    recorder: Recorder, wrapped: Callable[[CodedEnv], gym.Env[Any, Any]], length: int, rule: SuccessRule | None
) -> None:
    coded = CodedEnv()
    env = RewardModelWrapper(wrapped(coded), recorder, TASKS[0], options("pixels", terminate_on_success=rule))
    env.reset()
    for _ in range(length):
        _, _, terminated, truncated, _ = env.step(0)
    assert terminated or truncated
    for _ in range(2):
        with pytest.raises(ResetNeeded, match=r"^step: expected a reset, since the episode has ended, .*Autoreset"):
            env.step(0)
    assert coded.code == (0, 0, length)  # it was not stepped
    env.reset()
    assert recorder.calls[-1] == [([(0, 1, 0)], TASKS[0])]


@pytest.mark.parametrize(("step", "is_last"), [(0, False), (1, False), (3, True)])
@pytest.mark.parametrize("autoreset", [False, True])
def test_after_a_frame_that_could_not_be_kept_an_episode_needs_a_reset(
    recorder: Recorder, autoreset: bool, step: int, is_last: bool
) -> None:
    coded = CodedEnv(bad=(0, 0, step))
    env = RewardModelWrapper(Autoreset(coded) if autoreset else coded, recorder, TASKS[0], options(None))
    with pytest.raises(InvalidSampleError, match=r"^frame: expected uint8 \[H, W, 3\], got uint8 \[32, 3\]$"):
        env.reset()
        for _ in range(step):
            env.step(0)
    if is_last and autoreset:
        env.step(0)  # which is the reset
    else:
        with pytest.raises(
            ResetNeeded, match="the episode has ended" if is_last else "an earlier call failed|a reset before it"
        ):
            env.step(0)
        env.reset()
    env.step(0)
    assert recorder.calls[-2:] == [[up_to(0, 1, 0)], [up_to(0, 1, 1)]]


@pytest.mark.parametrize("mode", [NEXT_STEP, DISABLED], ids=lambda mode: mode.name)
def test_after_a_frame_that_could_not_be_kept_a_vector_needs_a_reset(recorder: Recorder, mode: AutoresetMode) -> None:
    coded = [CodedEnv(0, (3,)), CodedEnv(1, (3,), bad=(1, 0, 1))]
    makers: list[Callable[[], CodedEnv]] = [lambda: coded[0], lambda: coded[1]]
    env = RewardModelVectorWrapper(SyncVectorEnv(makers, autoreset_mode=mode), recorder, TASKS, options(None))
    env.reset()
    with pytest.raises(InvalidSampleError, match=r"^envs\[1\]\.frame: expected uint8"):
        env.step(ACTIONS)
    with pytest.raises(
        ResetNeeded, match=r"^step: expected a reset of the environments \[1\], since an earlier call failed"
    ):
        env.step(ACTIONS)
    env.reset(options={"reset_mask": np.array([False, True])})
    env.step(ACTIONS)
    assert recorder.calls[-1] == [up_to(0, 0, 2), up_to(1, 1, 1)]


def test_an_environment_that_resets_in_its_last_step_is_refused(recorder: Recorder) -> None:
    class Resetting(CodedEnv):
        def step(self, action: Any) -> Any:
            observation, reward, terminated, truncated, info = super().step(action)
            if terminated:
                return self.reset()[0], reward, terminated, truncated, {"final_observation": observation}
            return observation, reward, terminated, truncated, info

    env = RewardModelWrapper(Resetting(), recorder, TASKS[0], options("pixels"))
    env.reset()
    env.step(0)
    env.step(0)
    with pytest.raises(InvalidSampleError, match=r"^info: expected none of .*, got final_observation; .*Autoreset"):
        env.step(0)
    with pytest.raises(ResetNeeded):
        env.step(0)
    assert recorder.calls[-1] == [up_to(0, 0, 2)]


@pytest.mark.parametrize("wrapper", [RewardModelWrapper, RewardModelVectorWrapper])
def test_another_kind_of_vector_is_refused(recorder: Recorder, wrapper: Any) -> None:
    with pytest.raises(
        TypeError, match=r"^env: expected a gymnasium \w+, got .*object; .*wrap each environment in Rew"
    ):
        wrapper(object(), recorder, TASKS[0])


def test_rendered_frames_become_upright_rgb(recorder: Recorder) -> None:
    told = options(None, orient="rotate180", channels="bgr")
    env = RewardModelWrapper(CodedEnv(reuse=True), recorder, TASKS[0], told)
    env.reset()
    env.step(0)
    expected = [frame_of(0, 0, step)[::-1, ::-1, ::-1] for step in range(2)]
    np.testing.assert_array_equal(recorder.pixels[-1], expected)
