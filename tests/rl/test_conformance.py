# SPDX-License-Identifier: MIT
"""The rules of the rewards, at each door: single environments, vectors in each autoreset mode, Stable-Baselines3."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from itertools import cycle, islice, pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from coded_env import Code, CodedEnv, CodeReader, Recorder, ReturningEnv, frame_of
from environments import MAX_FRAMES, assert_close, progress
from reward_doors import (
    DOORS,
    ENDED_BY_SUCCESS,
    TASKS,
    VECTORS,
    Door,
    InProcesses,
    Sb3InProcesses,
    Vector,
    go_on,
    makers_of,
    played,
)
from rfm_client import InvalidSampleError, RewardClient, ServerUnavailableError
from rfm_rl import CopiedObservation, RewardOptions, SuccessRule

PROGRESS = (0.1, 0.4, 0.3, 0.3, 0.8)  # of an episode's frames
SUCCESS = (0.9, 0.2, 0.6, 0.1, 0.7)
LAST = len(PROGRESS) - 1
GAMMA = 0.9
LENGTHS = (3, 1), (4, 1, 2)  # steps of the episodes by environment, in turn
CALLS = 10
TERMINATES, TRUNCATES = 0, 1  # numbers of environments

at_each_door = pytest.mark.parametrize("kind", DOORS.values(), ids=DOORS)


class Judging(CodeReader):
    """Scores each frame by the step."""

    predicts_success = True

    def scores(self, codes: list[Code]) -> dict[str, Any]:
        steps = [step for *_, step in codes]
        success = np.array(SUCCESS)[steps] if self.predicts_success else np.nan
        return {"progress": np.array(PROGRESS)[steps], "success": success}


@pytest.fixture
def judge() -> Iterator[Recorder]:
    with Recorder(server=Judging()) as client:
        yield client


@pytest.fixture
def warnings(caplog: pytest.LogCaptureFixture) -> Callable[[], list[str]]:
    return lambda: [record.message for record in caplog.records if record.levelno == logging.WARNING]


def options(**more: Any) -> RewardOptions:
    return RewardOptions(**{"sampling": "all", "frames_from": "pixels", **more})


def opened(kind: type[Door], client: RewardClient, envs: Sequence[gym.Env[Any, Any]], asked: RewardOptions) -> Door:
    return kind(makers_of(envs), client, asked)


def changes(factor: float, values: Sequence[float] = PROGRESS) -> list[float]:
    return [factor * now - before for before, now in pairwise(values)]


STALE = [PROGRESS[t] for t in (0, 0, 2, 2, 4)]  # with a score every second step
ENDS = SuccessRule(0.5)
PAID: dict[str, tuple[dict[str, Any], list[float]]] = {
    "absolute": ({}, list(PROGRESS[1:])),
    "delta": ({"mode": "delta"}, changes(1)),
    "shaping": ({"mode": "shaping", "gamma": GAMMA}, changes(GAMMA)),
    "shaping with a bonus": (
        {"mode": "shaping", "gamma": GAMMA, "success_bonus": 10.0, "success": SuccessRule(0.65)},
        [*changes(GAMMA)[:-1], 10 - PROGRESS[3]],
    ),
    "shaping of the environment's own, ended by a success": (
        {"mode": "shaping", "gamma": GAMMA, "add_to_env_reward": True, "terminate_on_success": ENDS},
        [1 + changes(GAMMA)[0], 1 - PROGRESS[1]],
    ),
    "shaping, every second step": ({"mode": "shaping", "gamma": GAMMA, "every": 2}, changes(GAMMA, STALE)),
    "shaping of the environment's own": (
        {"mode": "shaping", "gamma": GAMMA, "scale": 2.0, "add_to_env_reward": True},
        [*(1 + 2 * change for change in changes(GAMMA)[:-1]), 1 - 2 * PROGRESS[3]],
    ),
    "final": ({"mode": "final"}, [0, 0, 0, PROGRESS[LAST]]),
    "final, ended by a success": ({"mode": "final", "terminate_on_success": ENDS}, [0, PROGRESS[2]]),
    "ended by a success that is scored": (
        {"every": 2, "terminate_on_success": SuccessRule(0.0)},
        [PROGRESS[0], PROGRESS[2]],
    ),
    "a bonus once": ({"mode": "delta", "success_bonus": 10.0}, [0.3, 9.9, 0, 0.5]),
    "a bonus that most of the last frames would have to earn": (
        {"mode": "delta", "success_bonus": 10.0, "success": SuccessRule(0.65, last=3)},
        [0.3, -0.1, 0, 0.5],
    ),
    "a bonus at the end alone": (
        {"mode": "final", "success_bonus": 2.0, "success": SuccessRule(0.65)},
        [0, 0, 0, 2.8],
    ),
    "a bonus that is not scaled": ({"scale": 0.0, "success_bonus": 1.0}, [0, 1, 0, 0]),
    "a bonus at the success that ends": (
        {"mode": "delta", "success_bonus": 10.0, "terminate_on_success": ENDS},
        [0.3, 9.9],
    ),
}
PAID_AT = [
    pytest.param(kind, asked, expected, id=f"{door}-{name}")
    for name, (asked, expected) in PAID.items()
    for door, kind in (ENDED_BY_SUCCESS if "terminate_on_success" in asked else DOORS).items()
]


@pytest.mark.parametrize(("kind", "asked", "expected"), PAID_AT)
def test_an_episode_is_paid_by_its_mode(
    judge: Recorder,
    warnings: Callable[[], list[str]],
    kind: type[Door],
    asked: dict[str, Any],
    expected: list[float],
) -> None:
    envs = [CodedEnv(TERMINATES, (LAST,)), CodedEnv(TERMINATES, (2,))]
    with opened(kind, judge, envs, options(**asked)) as door:
        episodes = [episode for episode in played(door, 3 * LAST)[0] if episode.terminated]
    assert len(episodes) >= 2
    for episode in episodes:
        np.testing.assert_allclose(episode.rewards, expected, atol=1e-6)
    assert warnings() == []


@pytest.mark.triton
@pytest.mark.parametrize("max_frames", [None, 3])
@at_each_door
def test_the_scores_of_a_server_are_paid(client: RewardClient, kind: type[Door], max_frames: int | None) -> None:
    envs = [CodedEnv(number, (length,)) for number, length in enumerate((5, 4))]
    asked = RewardOptions(mode="delta", frames_from="pixels", max_frames=max_frames)
    with opened(kind, client, envs, asked) as door:
        firsts = [episodes[0] for episodes in played(door, 5)]
    for number, episode in enumerate(firsts):
        video = [frame_of(number, 0, step) for step in range(len(episode.rewards) + 1)]
        scores = progress(client, video, range(len(video)), max_frames or MAX_FRAMES, TASKS[number])
        assert_close(episode.rewards, np.diff(scores))


@at_each_door
def test_info_has_the_same_keys_at_a_reset_and_at_a_step(judge: Recorder, kind: type[Door]) -> None:
    with opened(kind, judge, [CodedEnv(TERMINATES, (3,))], options(scale=2.0, success_bonus=5.0, every=2)) as door:
        ((first, second, *_),) = played(door, 8)
    for episode in (first, second):
        of_reset, *of_steps = (info["reward_model"] for info in episode.infos)
        assert {key: type(value) for key, value in of_reset.items()} == {
            key: type(value) for key, value in of_steps[0].items()
        }
        assert np.isnan([of_reset["reward"], of_reset["env_reward"]]).all()
        for step, (told, reward) in enumerate(zip(of_steps, episode.rewards, strict=False), 1):
            known = (0, 0, 2, 3)[step]  # the last is scored, too
            assert told == {
                "reward": pytest.approx(reward, abs=1e-6),
                "env_reward": 1.0,
                "progress": pytest.approx(PROGRESS[known]),
                "success": pytest.approx(SUCCESS[known]),
                "step": known,
                "lag": step - known,
                "skipped": 0,
                "succeeded": known >= 2,
            }


@at_each_door
def test_shaping_of_another_reward_pays_the_last_state_after_a_time_limit(judge: Recorder, kind: type[Door]) -> None:
    """An end without a time limit pays nothing for its state: see "shaping of the environment's own" in PAID."""
    asked = options(mode="shaping", gamma=GAMMA, add_to_env_reward=True, scale=2.0)
    with opened(kind, judge, [CodedEnv(TRUNCATES, (LAST,))], asked) as door:
        ended = played(door, LAST + 1)[0][0]
    assert ended.truncated
    assert ended.rewards == pytest.approx([1 + 2 * change for change in changes(GAMMA)], abs=1e-6)


@pytest.mark.parametrize(("bonus", "steps"), [(0.0, [0, LAST]), (1.0, list(range(LAST + 1)))])
@at_each_door
def test_final_scores_only_the_ends_unless_a_success_is_looked_for(
    judge: Recorder, kind: type[Door], bonus: float, steps: list[int]
) -> None:
    with opened(kind, judge, [CodedEnv(TERMINATES, (LAST,))], options(mode="final", success_bonus=bonus)) as door:
        played(door, LAST)
    asked = [codes[-1] for call in judge.calls for codes, _ in call]
    assert [step for _, episode, step in asked if episode == 0] == steps


@at_each_door
def test_a_bonus_needs_a_checkpoint_that_predicts_success(judge: Recorder, kind: type[Door]) -> None:
    judge.server.predicts_success = False  # type: ignore[attr-defined]
    needs = {"success_bonus: expected 0": {"success_bonus": 1.0}}
    if kind in ENDED_BY_SUCCESS.values():
        needs["terminate_on_success: expected None"] = {"terminate_on_success": ENDS}
    for message, asked in needs.items():
        with (
            opened(kind, judge, [CodedEnv()], options(**asked)) as door,
            pytest.raises(ValueError, match=f"^{message} with a checkpoint that does not predict success"),
        ):
            door.reset()
    with opened(kind, judge, [CodedEnv(TERMINATES, (LAST,))], options(mode="final")) as door:
        episode = played(door, LAST)[0][0]
    assert episode.rewards == pytest.approx([0, 0, 0, PROGRESS[LAST]])
    assert np.isnan([info["reward_model"]["success"] for info in episode.infos]).all()


@at_each_door
def test_after_an_error_delta_pays_the_missed_progress(judge: Recorder, kind: type[Door]) -> None:
    with opened(kind, judge, [CodedEnv(TERMINATES, (LAST,))], options(mode="delta")) as door:
        door.reset()
        judge.server.failing = 1
        with pytest.raises(ServerUnavailableError, match=r"^the server is restarting \(request \w+-\d+\)$"):
            door.step()
        assert door.step()[0].reward == pytest.approx(PROGRESS[2] - PROGRESS[0], abs=1e-6)


@at_each_door
def test_a_step_after_a_failed_reset_scores_the_first_frame_before_it_moves(judge: Recorder, kind: type[Door]) -> None:
    env = CodedEnv(TERMINATES, (LAST,))
    with opened(kind, judge, [env], options(mode="delta")) as door:
        for judge.server.failing, call in enumerate((door.reset, door.step)):
            with pytest.raises(ServerUnavailableError):
                call()
        assert env.t == 0
        assert door.step()[0].reward == pytest.approx(PROGRESS[1] - PROGRESS[0], abs=1e-6)


# Which frames are sent. Each encodes environment, episode and step.

CANVAS = CodedEnv().canvas


def drawn(observation: Any) -> Any:
    """Return the frame of an observation; all environments draw into the same array."""
    CANVAS[:] = observation["pixels"]
    return CANVAS


SOURCES: dict[str, Any] = {"rendered": None, "a key": "pixels", "a function": drawn}
SENT = [
    pytest.param(kind, source, reuse, None, id=f"{door}-{name}{'-reused' if reuse else ''}")
    for door, kind in DOORS.items()
    for name, source in SOURCES.items()
    for reuse in (False, True)
    if kind is not VECTORS["SAME_STEP"] or source  # which renders no frames
]
SENT += [
    pytest.param(kind, "pixels", True, call, id=f"{door}-fails at {call}")
    for door, kind in DOORS.items()
    for call in range(CALLS - 1)
]


def up_to(code: Code, task: str) -> tuple[list[Code], str]:
    """Return the question about a step: all frames of the episode so far, and the task."""
    number, episode, step = code
    return [(number, episode, each) for each in range(step + 1)], task


def questions(number: int, lengths: Sequence[int]) -> Iterator[tuple[list[Code], str]]:
    """Yield the questions about an environment, in order."""
    for episode, length in enumerate(cycle(lengths)):
        for step in range(length + 1):
            yield up_to((number, episode, step), TASKS[number])


def check_asked(calls: Sequence[list[tuple[list[Code], str]]], num_envs: int, fewest: int) -> None:
    for number in range(num_envs):
        asked = [question for call in calls for question in call if question[0][0][0] == number]
        assert len(asked) >= fewest
        assert asked == list(islice(questions(number, LENGTHS[number]), len(asked)))


@pytest.mark.parametrize(("kind", "source", "reuse", "failing"), SENT)
def test_each_question_has_the_frames_of_its_own_episode(
    kind: type[Door], source: Any, reuse: bool, failing: int | None
) -> None:
    """Also after a failed call, whose frame is part of the episode. A step after an episode's end is refused."""
    envs = [CodedEnv(number, lengths, reuse=reuse) for number, lengths in enumerate(LENGTHS)]
    envs = envs if kind.asks_once else envs[:1]
    with Recorder(failing) as client, opened(kind, client, envs, options(frames_from=source)) as door:
        for call in range(CALLS):
            with pytest.raises(ServerUnavailableError) if call == failing else nullcontext():
                go_on(door, envs) if call else door.reset()
    calls = list(client.calls)
    firsts = [question for question in calls[failing] if len(question[0]) == 1] if failing is not None else []
    assert not firsts or calls.pop(failing + 1) == firsts  # asked again
    assert len(calls) == CALLS
    check_asked(calls, len(envs), CALLS - 3)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "source"), [(InProcesses, "pixels"), (Sb3InProcesses, None)])
def test_environments_in_processes_send_their_own_frames(recorder: Recorder, kind: type[Door], source: Any) -> None:
    envs = [CopiedObservation(CodedEnv(number, lengths, reuse=True)) for number, lengths in enumerate(LENGTHS)]
    with opened(kind, recorder, envs, options(frames_from=source)) as door:
        door.reset()
        for _ in range(CALLS):
            door.step()
    check_asked(recorder.calls, 2, CALLS)


@pytest.mark.parametrize(("step", "is_last"), [(0, False), (1, False), (3, True)])
@at_each_door
def test_after_a_frame_that_could_not_be_kept_an_episode_needs_a_reset(
    recorder: Recorder, kind: type[Door], step: int, is_last: bool
) -> None:
    envs = [CodedEnv(bad=(0, 0, step))]
    if kind is VECTORS["SAME_STEP"]:
        pytest.skip("it renders no frames")
    with opened(kind, recorder, envs, options(frames_from=None)) as door:
        with pytest.raises(InvalidSampleError, match=r"frame: expected uint8 \[H, W, 3\], got uint8 \[32, 3\]$"):
            door.reset()
            for _ in range(step):
                door.step()
        if not (is_last and kind is VECTORS["NEXT_STEP"]):  # which resets in the next step
            reason = "a reset before it|an earlier call failed|ha(s|ve) ended"
            with pytest.raises(ResetNeeded, match=f"^step: expected a reset of every|^step: expected .*({reason})"):
                door.step()
            door.reset()
        else:
            door.step()
        door.step()
    ((codes, _),) = recorder.calls[-1]
    assert [code[2] for code in codes] == [0, 1]
    assert codes[0][1] > 0


def test_a_vector_goes_on_after_a_reset_of_the_environment_that_lost_a_frame(recorder: Recorder) -> None:
    envs = [CodedEnv(0, (3,)), CodedEnv(1, (3,), bad=(1, 0, 1))]
    with opened(VECTORS["DISABLED"], recorder, envs, options(frames_from=None)) as door:
        door.reset()
        with pytest.raises(InvalidSampleError, match=r"^envs\[1\]\.frame: expected uint8"):
            door.step()
        expected = r"^step: expected a reset of the environments \[1\], since an earlier call failed"
        with pytest.raises(ResetNeeded, match=expected):
            door.step()
        door.reset([False, True])
        door.step()
    assert recorder.calls[-1] == [up_to((0, 0, 2), TASKS[0]), up_to((1, 1, 1), TASKS[1])]


@at_each_door
def test_an_episode_that_ends_where_the_next_begins_is_paid(judge: Recorder, kind: type[Door]) -> None:
    with opened(kind, judge, [ReturningEnv()], options()) as door:
        ended = [episode for episode in played(door, 8)[0] if episode.terminated]
    assert len(ended) >= 2
    for episode in ended:
        assert episode.rewards == pytest.approx([PROGRESS[1], PROGRESS[0]])


@pytest.mark.slow
@pytest.mark.parametrize("since", [0, 1])
def test_a_process_that_may_have_drawn_over_a_last_frame_is_refused(judge: Recorder, since: int) -> None:
    """Until an episode's last frame differs from the next one's first."""
    expected = r"^final_obs\[0\]: expected the last frame .*, got the first frame .*rfm_rl\.CopiedObservation"
    refused = pytest.raises(InvalidSampleError, match=expected) if since == 0 else nullcontext()
    with opened(InProcesses, judge, [ReturningEnv(since)], options()) as door, refused:
        assert len(played(door, 4)[0]) == 3


@pytest.mark.parametrize("kind", [kind for kind in DOORS.values() if kind is not VECTORS["SAME_STEP"]])
def test_rendered_frames_become_upright_rgb(recorder: Recorder, kind: type[Door]) -> None:
    asked = options(frames_from=None, orient="rotate180", channels="bgr")
    with opened(kind, recorder, [CodedEnv(reuse=True)], asked) as door:
        door.reset()
        door.step()
    expected = [frame_of(0, 0, step)[::-1, ::-1, ::-1] for step in range(2)]
    np.testing.assert_array_equal(recorder.pixels[-1], expected)


NO_FRAMES: dict[str, tuple[dict[str, Any], str]] = {
    "no frame": (
        {"frames_from": lambda seen: seen["pixels"] / 255},
        r"frame: expected uint8 \[H, W, 3\], got float64 \[32, 32, 3\]$",
    ),
    "a camera is missing": (
        {"frames_from": lambda seen: {"front": seen["pixels"]}, "cameras": ["front", "top"]},
        r"frames: expected a frame of each of the cameras \['front', 'top'\], got \['front'\]$",
    ),
    "no cameras": ({"frames_from": "pixels", "cameras": ["front"]}, r"the cameras \['front'\], got ndarray$"),
}


@pytest.mark.parametrize(("asked", "message"), NO_FRAMES.values(), ids=NO_FRAMES)
@at_each_door
def test_an_observation_without_the_frame_is_refused(
    recorder: Recorder, kind: type[Door], asked: dict[str, Any], message: str
) -> None:
    with (
        opened(kind, recorder, [CodedEnv()], options(**asked)) as door,
        pytest.raises(InvalidSampleError, match=message),
    ):
        door.reset()


class ResettingEnv(CodedEnv):
    """Resets in the step that ends an episode, and returns the observation from before, as LeRobot's environments do.

    tells: a key in the info of this step; None, as in LeRobot's VLABench: none
    """

    tells: str | None = "final_info"

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        if terminated:
            info = {self.tells: {"is_success": True}} if self.tells else {}
            self.reset()
        return observation, reward, terminated, truncated, info


@at_each_door
def test_an_environment_that_resets_in_its_last_step_is_paid_by_its_observation(
    judge: Recorder, kind: type[Door]
) -> None:
    with opened(kind, judge, [ResettingEnv(TERMINATES, (2,))], options()) as door:
        ended = [episode for episode in played(door, 8)[0] if episode.terminated]
    assert len(ended) >= 2
    for episode in ended:
        assert episode.rewards == pytest.approx(PROGRESS[1:3])


@pytest.mark.parametrize("tells", ["final_info", None])
@pytest.mark.parametrize("kind", [kind for kind in DOORS.values() if kind is not VECTORS["SAME_STEP"]])
def test_an_environment_that_resets_in_its_last_step_is_not_rendered(
    recorder: Recorder, kind: type[Door], tells: str | None
) -> None:
    expected = r"^(info|infos\[0\]): expected no reset in the last step .* frames_from='pixels'$"
    env = ResettingEnv(TERMINATES, (2,))
    env.tells = tells
    with opened(kind, recorder, [env], options(frames_from=None)) as door:
        door.reset()
        door.step()
        with pytest.raises(InvalidSampleError, match=expected):
            door.step()
    assert [codes[-1] for call in recorder.calls for codes, _ in call] == [(0, 0, 0), (0, 0, 1)]


def test_an_environment_that_returns_the_next_observation_in_its_last_step_is_refused(recorder: Recorder) -> None:
    env = ResettingEnv(TERMINATES, (1,))
    env.tells = "final_observation"
    with opened(DOORS["single"], recorder, [env], options()) as door:
        door.reset()
        with pytest.raises(InvalidSampleError, match=r"^info: expected none of .*, got final_observation; .*Autoreset"):
            door.step()
        with pytest.raises(ResetNeeded):
            door.step()


@pytest.mark.parametrize("kind", [kind for kind in DOORS.values() if issubclass(kind, Vector)])
def test_a_vector_exposes_its_autoreset_mode(recorder: Recorder, kind: type[Vector]) -> None:
    """TorchRL reads it."""
    assert kind(makers_of([CodedEnv()]), recorder, options()).env.autoreset_mode is kind.mode


# Early resets, after which a reward is never paid.

WARNED = (
    "reset: expected the end of the episode before it, got one after 2 steps, whose reward is lost; put the time limit "
    "inside the wrapper: RewardModelWrapper(TimeLimit(env, steps), ...), or gymnasium.make(..., max_episode_steps=steps)"
)
REFUSED = "reset: expected the end of an episode before it, where mode 'final' pays, got one after 2 steps, .*TimeLimit"


def cut(door: Door) -> None:
    """Reset, and step twice."""
    door.reset()
    for _ in range(2):
        door.step()


def of_first(door: Door) -> str:
    return "envs[0]: " if door.asks_once else ""


@at_each_door
def test_final_refuses_the_second_early_reset_in_a_row(
    recorder: Recorder, warnings: Callable[[], list[str]], kind: type[Door]
) -> None:
    """It says so in the log at the first, which might be deliberate. A caller who means it may go on."""
    with opened(kind, recorder, [CodedEnv()], options(mode="final")) as door:
        cut(door)
        assert warnings() == []
        cut(door)
        assert warnings() == [of_first(door) + WARNED]
        with pytest.raises(ValueError, match=rf"^(envs\[0\]: )?{REFUSED}"):
            cut(door)
        cut(door)
    assert warnings() == [of_first(door) + WARNED]


@at_each_door
def test_an_end_between_early_resets_allows_them(
    recorder: Recorder, warnings: Callable[[], list[str]], kind: type[Door]
) -> None:
    """Evaluations reset early; of a vector, one environment may end in time."""
    envs = [CodedEnv(0, (3,)), CodedEnv(1, (2,))] if kind.asks_once else [CodedEnv(0, (3, 2))]
    with opened(kind, recorder, envs, options(mode="final")) as door:
        for _ in range(4):
            cut(door)
    assert warnings() == [of_first(door) + WARNED]


CUT: dict[str, tuple[dict[str, Any], bool]] = {  # options, and whether the last step's reward is lost
    "each step is paid": ({"mode": "delta"}, False),
    "every fourth step is scored": ({"mode": "delta", "every": 4}, True),
    "final, which scores each step for the bonus": ({"mode": "final", "success_bonus": 1.0}, True),
}


@pytest.mark.parametrize(("asked", "is_lost"), CUT.values(), ids=CUT)
@at_each_door
def test_a_reset_that_drops_a_reward_warns_once(
    recorder: Recorder, warnings: Callable[[], list[str]], kind: type[Door], asked: dict[str, Any], is_lost: bool
) -> None:
    with opened(kind, recorder, [CodedEnv()], options(**asked)) as door:
        for _ in range(2):
            cut(door)
            played(door, 3)
    assert warnings() == [of_first(door) + WARNED] * is_lost


@at_each_door
def test_resets_after_an_error_are_silent(
    recorder: Recorder, warnings: Callable[[], list[str]], kind: type[Door]
) -> None:
    """The error at a last step is an end; after others, the reset is the remedy."""
    for length in (1, 3):
        with opened(kind, recorder, [CodedEnv(0, (length,))], options(mode="final", success_bonus=1.0)) as door:
            recorder.server.failing = len(recorder.calls) + 1
            door.reset()
            with pytest.raises(ServerUnavailableError):
                door.step()
            door.reset()
    if kind is not VECTORS["SAME_STEP"]:  # which renders no frames
        with opened(kind, recorder, [CodedEnv(bad=(0, 0, 1))], options(mode="final", frames_from=None)) as door:
            door.reset()
            with pytest.raises(InvalidSampleError):
                door.step()
            door.reset()
    assert warnings() == []
    with opened(kind, recorder, [CodedEnv()], options(mode="final", success_bonus=1.0)) as door:
        for _ in range(3):
            door.reset()
            recorder.server.failing = len(recorder.calls)
            with pytest.raises(ServerUnavailableError):
                door.step()


REFUSED_OPTIONS: dict[str, tuple[dict[str, Any], str]] = {
    "mode": ({"mode": "relative"}, "^mode: expected one of absolute, delta, shaping, final, got 'relative'$"),
    "no gamma": ({"mode": "shaping"}, "^gamma: expected the policy's discount, .* with mode 'shaping', got None$"),
    "a gamma above 1": (
        {"mode": "shaping", "gamma": 1.1},
        "^gamma: expected the policy's discount, above 0 and at most",
    ),
    "a gamma of another mode": ({"mode": "delta", "gamma": 0.9}, "^gamma: expected None with mode 'delta', got 0.9$"),
    "a rule of no bonus": ({"success": SuccessRule()}, "^success: expected None without success_bonus "),
    "two rules": (
        {"success": SuccessRule(0.9), "success_bonus": 1.0, "terminate_on_success": SuccessRule(0.8)},
        "^success: expected None or the rule of terminate_on_success, ",
    ),
    "fuse": ({"fuse": "sum"}, "^fuse: expected one of mean, min, max, got 'sum'$"),
    "orient": ({"orient": "upside-down"}, "^orient: expected one of none, rotate180, .*, got 'upside-down'$"),
    "orient of a camera": ({"orient": {"front": "none"}}, "^orient: expected one for all frames, .*, got 'front'$"),
}


@pytest.mark.parametrize(("asked", "message"), REFUSED_OPTIONS.values(), ids=REFUSED_OPTIONS)
def test_options_that_cannot_be_right_are_refused(asked: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RewardOptions(**asked)


@at_each_door
def test_an_environment_that_draws_no_frames_is_refused(recorder: Recorder, kind: type[Door]) -> None:
    env = CodedEnv()
    env.render_mode = None  # type: ignore[assignment]
    with pytest.raises(ValueError, match=r"^render_mode: expected 'rgb_array', .* got None$"):
        opened(kind, recorder, [env], options(frames_from=None))


@pytest.mark.parametrize("kind", VECTORS.values(), ids=VECTORS)
def test_a_vector_needs_a_task_for_each_environment(recorder: Recorder, kind: type[Door]) -> None:
    door = kind.__new__(kind)
    with pytest.raises(ValueError, match=r"^task: expected one for each of the 2 environments, got 1$"):
        door.wrap(makers_of([CodedEnv(), CodedEnv()]), recorder, ["task 0"], options())


INSTEAD = "wrap each environment in RewardModelWrapper instead$"
REFUSED_DOORS: dict[str, tuple[Sequence[str], dict[str, Any], str]] = {
    "an unknown key": (
        list(DOORS),
        {"frames_from": "camera"},
        r"^frames_from: expected a key of the .*\['pixels'\], got",
    ),
    "unknown cameras": (
        list(DOORS),
        {"frames_from": None, "cameras": ["front"]},
        r"^cameras: expected keys of the observation \['pixels'\], got \['front'\]$",
    ),
    "frames that a vector never renders": (
        ["SAME_STEP"],
        {"frames_from": None},
        rf"^autoreset_mode: expected NEXT_STEP or DISABLED with frames from render\(\), .* got SAME_STEP; make the vector with .*NEXT_STEP, or {INSTEAD}",
    ),
    "an end that a vector does not learn of": (
        ["NEXT_STEP", "SAME_STEP"],
        {"terminate_on_success": ENDS},
        f"^autoreset_mode: expected DISABLED with terminate_on_success, got [NS].*; make the vector with .*DISABLED, or {INSTEAD}",
    ),
    "an end that a VecEnv does not learn of": (
        ["VecEnv"],
        {"terminate_on_success": ENDS},
        f"^terminate_on_success: expected None, since a VecEnv resets, got .*{INSTEAD}",
    ),
}
REFUSED_AT = [
    pytest.param(DOORS[door], asked, message, id=f"{door}-{name}")
    for name, (doors, asked, message) in REFUSED_DOORS.items()
    for door in doors
]


@pytest.mark.parametrize(("kind", "asked", "message"), REFUSED_AT)
def test_a_door_refuses_options_that_it_cannot_honour(
    recorder: Recorder, kind: type[Door], asked: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        opened(kind, recorder, [CodedEnv()], options(**asked))


@pytest.mark.parametrize("kind", ENDED_BY_SUCCESS.values())
def test_a_success_ends_an_episode_and_a_step_after_it_is_refused(judge: Recorder, kind: type[Door]) -> None:
    envs = [CodedEnv(TERMINATES, (LAST,)) for _ in range(2)]
    with opened(kind, judge, envs, options(terminate_on_success=ENDS)) as door:
        door.reset()
        first, second = (door.step()[0] for _ in range(2))
        assert [said.ends for said in (first, second)] == [False, True]
        assert (second.terminated, second.truncated) == (True, False)
        assert [said.info["reward_model"]["succeeded"] for said in (first, second)] == [False, True]
        with pytest.raises(ResetNeeded, match=r"^step: expected a reset.*(has|have) ended, got another step; call"):
            door.step()
        assert envs[0].code == (TERMINATES, 0, 2)  # it was not stepped
        assert list(door.reset([True, False])) == [0]
        with pytest.raises(ResetNeeded, match=r"^step: expected a reset(,| of the environments \[1\],) since"):
            door.step()
        door.reset([False, True])
        assert judge.calls[-1][0][0] == [(TERMINATES, 1, 0)]
