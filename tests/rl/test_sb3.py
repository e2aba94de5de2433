# SPDX-License-Identifier: MIT
"""What only the vectors of Stable-Baselines3 have to do; the rules are in test_conformance.py."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from coded_env import CodedEnv, Recorder
from environments import TASK, cart_pole_with_pixels
from rfm_client import RewardClient
from rfm_rl import RewardModelWrapper, RewardOptions

pytest.importorskip("stable_baselines3", reason="the extra sb3 is not installed")

from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from rfm_rl.sb3 import RenderedFrame, RewardModelVecEnv


@pytest.mark.triton
def test_a_vector_is_paid_as_its_environments_would_be(client: RewardClient) -> None:
    rewarded = RewardOptions(mode="delta", every=2, frames_from="pixels")
    singles = DummyVecEnv([lambda: RewardModelWrapper(cart_pole_with_pixels(), client, TASK, rewarded)] * 2)
    vector = RewardModelVecEnv(DummyVecEnv([cart_pole_with_pixels] * 2), client, TASK, rewarded)
    told = []
    for env in (vector, singles):
        env.seed(0)
        env.reset()
        steps = [env.step(np.array([0, 1])) for _ in range(24)]
        assert sum(step[2].sum() for step in steps) >= 4
        told.append([(step[1], [info["reward_model"]["progress"] for info in step[3]]) for step in steps])
    for left, right in zip(*told, strict=True):
        np.testing.assert_allclose(left[0], right[0], atol=1e-5)
        np.testing.assert_allclose(left[1], right[1], atol=1e-5)


def test_the_rendered_frame_is_taken_out_of_the_infos(recorder: Recorder) -> None:
    venv = VecMonitor(DummyVecEnv([partial(rendered, 1)]))
    env = RewardModelVecEnv(venv, recorder, TASK, RewardOptions(sampling="all"))
    env.reset()
    for _ in range(2):
        infos = env.step(np.zeros(1, int))[3]
        assert not [key for info in (*infos, *env.reset_infos) for key in info if "frame" in key]


def rendered(length: int) -> RenderedFrame:
    return RenderedFrame(CodedEnv(0, (length,)))


REFUSED: dict[str, tuple[Any, type[Exception], str]] = {
    "no VecEnv": (CodedEnv, TypeError, "^venv: expected a VecEnv of stable_baselines3, got .*CodedEnv"),
    "no pictures": (
        lambda: DummyVecEnv([CodedEnv]),
        ValueError,
        r"^venv: expected each environment in RenderedFrame, .*: make_vec_env\(..., wrapper_class=RenderedFrame\)$",
    ),
    "a normalization": (
        lambda: VecMonitor(VecNormalize(DummyVecEnv([partial(rendered, 1)]), norm_obs=False)),
        ValueError,
        r"^venv: expected no VecNormalize inside.*; wrap in the other order: VecNormalize\(RewardModelVecEnv",
    ),
}


@pytest.mark.parametrize(("make", "error", "message"), REFUSED.values(), ids=REFUSED)
def test_a_vector_that_cannot_be_paid_is_refused(
    recorder: Recorder, make: Any, error: type[Exception], message: str
) -> None:
    """Off-policy algorithms look for a ``VecNormalize`` and store the rewards that it got."""
    with pytest.raises(error, match=message):
        RewardModelVecEnv(make(), recorder, TASK, RewardOptions())
