# SPDX-License-Identifier: MIT
"""The wrappers' pay for progress and success, by mode."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from coded_env import Code, CodedEnv, CodeReader, Recorder
from rfm_rl import RewardModelVectorWrapper, RewardModelWrapper, RewardOptions, SuccessRule

PROGRESS = (0.1, 0.4, 0.3, 0.3, 0.8)  # of an episode's frames
SUCCESS = (0.9, 0.2, 0.6, 0.1, 0.7)
LAST = len(PROGRESS) - 1
GAMMA = 0.9
TASK = "task 0"


class Judging(CodeReader):
    """Scores each frame by the step."""

    predicts_success = True

    def scores(self, codes: list[Code]) -> dict[str, Any]:
        steps = [step for *_, step in codes]
        success = np.array(SUCCESS)[steps] if self.predicts_success else np.nan
        return {"progress": np.array(PROGRESS)[steps], "success": success}


class Judge(Recorder):
    """A client of such a server."""

    def __init__(self, predicts_success: bool = True) -> None:
        server = Judging()
        server.predicts_success = predicts_success
        super().__init__(server=server)

    @property
    def steps(self) -> list[int]:
        """The steps that were asked about."""
        return [codes[-1][2] for call in self.calls for codes, _ in call]


@pytest.fixture
def judge() -> Iterator[Judge]:
    with Judge() as client:
        yield client


def rewards(judge: Judge, **options: Any) -> list[float]:
    """The labels of an episode."""
    env = RewardModelWrapper(CodedEnv(0, (LAST,)), judge, TASK, RewardOptions(sampling="all", **options))
    env.reset()
    paid = []
    ended = False
    while not ended:
        _, reward, terminated, truncated, _ = env.step(0)
        paid.append(reward)
        ended = terminated or truncated
    return paid


def changes(factor: float, values: Sequence[float] = PROGRESS) -> list[float]:
    return [factor * now - before for before, now in pairwise(values)]


RULE = SuccessRule(0.65)
STALE = [PROGRESS[t] for t in (0, 0, 2, 2, 4)]  # with a score every second step
PAID: dict[str, tuple[dict[str, Any], list[float]]] = {
    "absolute": ({}, list(PROGRESS[1:])),
    "delta": ({"mode": "delta"}, changes(1)),
    "shaping": ({"mode": "shaping", "gamma": GAMMA}, changes(GAMMA)),
    "shaping with a bonus": (
        {"mode": "shaping", "gamma": GAMMA, "success_bonus": 10.0, "success": SuccessRule(0.65)},
        [*changes(GAMMA)[:-1], 10 - PROGRESS[3]],
    ),
    "shaping of the environment's own, ended by a success": (
        {"mode": "shaping", "gamma": GAMMA, "add_to_env_reward": True, "terminate_on_success": SuccessRule(0.5)},
        [1 + changes(GAMMA)[0], 1 - PROGRESS[1]],
    ),
    "shaping, ended by a success": (
        {"mode": "shaping", "gamma": GAMMA, "terminate_on_success": SuccessRule(0.5)},
        changes(GAMMA)[:2],
    ),
    "shaping, every second step": ({"mode": "shaping", "gamma": GAMMA, "every": 2}, changes(GAMMA, STALE)),
    "shaping of the environment's own": (
        {"mode": "shaping", "gamma": GAMMA, "scale": 2.0, "add_to_env_reward": True},
        [*(1 + 2 * change for change in changes(GAMMA)[:-1]), 1 - 2 * PROGRESS[3]],
    ),
    "final": ({"mode": "final"}, [0, 0, 0, PROGRESS[LAST]]),
    "final, scaled": ({"mode": "final", "scale": 3.0}, [0, 0, 0, 3 * PROGRESS[LAST]]),
    "final, ended by a success": ({"mode": "final", "terminate_on_success": SuccessRule(0.5)}, [0, PROGRESS[2]]),
    "a bonus once": ({"mode": "delta", "success_bonus": 10.0}, [0.3, 9.9, 0, 0.5]),
    "a bonus by its own rule": ({"mode": "delta", "success_bonus": 10.0, "success": RULE}, [0.3, -0.1, 0, 10.5]),
    "a bonus at the end alone": ({"mode": "final", "success_bonus": 2.0, "success": RULE}, [0, 0, 0, 2.8]),
    "a bonus that is not scaled": ({"scale": 0.0, "success_bonus": 1.0}, [0, 1, 0, 0]),
    "a bonus at the success that ends": (
        {"mode": "delta", "success_bonus": 10.0, "terminate_on_success": SuccessRule(0.5)},
        [0.3, 9.9],
    ),
    "no bonus without a success": (
        {"mode": "final", "success_bonus": 2.0, "success": SuccessRule(0.95)},
        [0, 0, 0, 0.8],
    ),
}


@pytest.mark.parametrize(("options", "expected"), PAID.values(), ids=PAID)
def test_an_episode_is_paid_by_its_mode(judge: Judge, options: dict[str, Any], expected: list[float]) -> None:
    np.testing.assert_allclose(rewards(judge, **options), expected, atol=1e-6)


def test_a_policy_that_hovers_earns_nothing_by_shaping(judge: Judge) -> None:
    """The discounted sum depends on both ends alone, also with old scores."""
    for every in (1, 2, 3):
        paid = rewards(judge, mode="shaping", gamma=GAMMA, every=every)
        discounted = sum(GAMMA**t * reward for t, reward in enumerate(paid))
        assert discounted == pytest.approx(GAMMA**LAST * PROGRESS[LAST] - PROGRESS[0], abs=1e-6)


@pytest.mark.parametrize("number", [0, 1], ids=["terminated", "truncated"])
@pytest.mark.parametrize("kind", ["one", "vector", "VecEnv"])
def test_shaping_of_another_reward_leaves_its_best_policies_as_they_are(judge: Judge, kind: str, number: int) -> None:
    """Shaping adds a sum that depends on the reset alone; after a time limit, also on the last state."""
    options = RewardOptions(
        mode="shaping", gamma=GAMMA, add_to_env_reward=True, sampling="all", frames_from="pixels", scale=2.0
    )
    sums = []
    for length in (2, LAST):
        paid = paid_by(kind, partial(CodedEnv, number, (length,)), judge, options, length)
        sums.append(sum(GAMMA**t * (reward - 1) for t, reward in enumerate(paid)))
    kept = [0.0, 0.0] if number == 0 else [2 * GAMMA**length * PROGRESS[length] for length in (2, LAST)]
    assert sums == pytest.approx([left - 2 * PROGRESS[0] for left in kept], abs=1e-6)


def paid_by(kind: str, make: Any, judge: Judge, options: RewardOptions, length: int) -> list[float]:
    """Return an episode's rewards by wrapper."""
    if kind == "one":
        env: Any = RewardModelWrapper(make(), judge, TASK, options)
        env.reset()
        return [env.step(0)[1] for _ in range(length)]
    if kind == "vector":
        env = RewardModelVectorWrapper(SyncVectorEnv([make]), judge, TASK, options)
    else:
        vectors = pytest.importorskip("stable_baselines3.common.vec_env", reason="the extra sb3 is not installed")
        from rfm_rl.sb3 import RewardModelVecEnv

        env = RewardModelVecEnv(vectors.DummyVecEnv([make]), judge, TASK, options)
    env.reset()
    return [float(env.step(np.zeros(1, int))[1][0]) for _ in range(length)]


def test_final_scores_only_the_ends_unless_a_success_is_looked_for(judge: Judge) -> None:
    rewards(judge, mode="final")
    assert judge.steps == [0, LAST]
    judge.calls.clear()
    rewards(judge, mode="final", success_bonus=1.0)
    assert judge.steps == list(range(LAST + 1))


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.name)
def test_a_vector_pays_each_episode_s_end_and_bonus(judge: Judge, mode: AutoresetMode) -> None:
    makers = [partial(CodedEnv, number, (length,)) for number, length in enumerate((2, LAST))]
    options = RewardOptions(mode="final", success_bonus=2.0, sampling="all", frames_from="pixels")
    env = RewardModelVectorWrapper(SyncVectorEnv(makers, autoreset_mode=mode), judge, TASK, options)
    env.reset()
    told = [env.step(np.zeros(2, int)) for _ in range(2)]
    np.testing.assert_allclose([step[1] for step in told], [[0, 0], [2 + PROGRESS[2], 2]], atol=1e-6)
    if mode is AutoresetMode.DISABLED:
        env.reset(options={"reset_mask": np.array([True, False])})
    for _ in range(2):
        told.append(env.step(np.zeros(2, int)))
    assert told[3][1][1] == pytest.approx(PROGRESS[LAST])
    infos = told[3][4]["final_info"] if mode is AutoresetMode.SAME_STEP else told[3][4]
    assert infos["reward_model"]["succeeded"][1]


def test_a_bonus_needs_a_checkpoint_that_predicts_success() -> None:
    with Judge(predicts_success=False) as judge:
        with pytest.raises(
            ValueError, match=r"^success_bonus: expected 0 with a checkpoint that does not predict success"
        ):
            rewards(judge, success_bonus=1.0)
        assert rewards(judge, mode="final") == pytest.approx([0, 0, 0, PROGRESS[LAST]])


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
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
    "an end that is not awaited": (
        {"mode": "final", "blocking": False, "await_last": False},
        "^await_last: expected True with mode 'final'",
    ),
}


@pytest.mark.parametrize(("options", "message"), REFUSED.values(), ids=REFUSED)
def test_options_that_contradict_each_other_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RewardOptions(**options)
