# SPDX-License-Identifier: MIT
"""The class of a Monitor that writes a file."""

from __future__ import annotations

import pickle

from rfm_rl.own_rewards import WritingMonitor


def test_a_subprocess_gets_the_class_of_a_monitor_that_writes() -> None:
    """A SubprocVecEnv pickles it."""
    assert pickle.loads(pickle.dumps(WritingMonitor)) is WritingMonitor
