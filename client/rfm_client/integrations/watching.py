# SPDX-License-Identifier: MIT
"""What the tab Live of a gateway's page is told of an environment's episode. Says nothing without a live view."""

from __future__ import annotations

import time

import numpy as np

from rfm_client.contract.results import FrameScores
from rfm_client.contract.samples import UInt8Array
from rfm_client.episodes.live import LiveView
from rfm_client.episodes.options import SuccessRule
from rfm_client.episodes.scores import StepScore


class Watching:
    """Reports one episode, if somebody watches.

    rule: when a step counts as a success; None: SuccessRule()
    env: number of its environment
    """

    def __init__(self, live: LiveView | None, task: str, rule: SuccessRule | None, env: int) -> None:
        self._rule = rule or SuccessRule()
        self._episode = None if live is None else live.episode(task, env, self._rule.threshold)

    def add(self, step: int, frame: UInt8Array, scores: FrameScores, asked_s: float) -> None:
        """Reports a step whose scores have come. asked_s: when they were asked for, by ``time.perf_counter``"""
        if self._episode is None:
            return
        progress, success = float(scores.progress[-1]), float(scores.success[-1])
        has_succeeded = step > 0 and not np.isnan(success) and scores.succeeded(
            last=self._rule.last, threshold=self._rule.threshold
        )  # fmt: skip
        ms = (time.perf_counter() - asked_s) * 1e3
        self._episode.add(frame, StepScore(progress, success, has_succeeded, step, ms))

    def end(self) -> None:
        """Reports that no step will follow."""
        if self._episode is not None:
            self._episode.end()
