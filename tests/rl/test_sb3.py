# SPDX-License-Identifier: MIT
"""What only the vectors of Stable-Baselines3 have to do; the rules are in test_conformance.py."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from coded_env import CodedEnv, Recorder
from environments import TASK
from rfm_rl import RewardOptions

pytest.importorskip("stable_baselines3", reason="the extra sb3 is not installed")

from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from rfm_rl.sb3 import RenderedFrame, RewardModelVecEnv


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
