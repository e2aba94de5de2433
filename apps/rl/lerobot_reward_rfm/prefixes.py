# SPDX-License-Identifier: MIT
"""Scores of frames, each on the frames up to it alone, sampled by the rule of the configuration or the checkpoint."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain, islice
from typing import Any, cast

from lerobot_reward_rfm.configuration_rfm import RfmRewardConfig
from rfm_client import InferenceFailedError, ModelInfo, ProgressResult, ProgressSample, RewardClient, Trajectory
from rfm_client.frames import Sampling

AT_A_TIME = 32  # samples: each copies its frames, so that those of all prefixes of an episode would fill memory


def rule_of(info: ModelInfo, config: RfmRewardConfig) -> Sampling:
    """Return the sampling rule. Raises ValueError without a number that it needs.

    Raises InvalidSampleError for a checkpoint that cannot score while an episode runs.
    """
    info.check_scores_prefixes()
    rule = cast(Any, config.sampling)
    return Sampling.of(rule, config.frames, info.max_frames, trained_padding=info.trained_padding)


def newest_scores(
    client: RewardClient, trajectories: Sequence[Trajectory], config: RfmRewardConfig
) -> list[ProgressResult]:
    """Return the scores of the newest frame of each trajectory, [1], from few requests. Raises RewardError."""
    rule = rule_of(client.model_info(frames=True), config)
    prefixes = [rule.prefix(trajectory.num_frames - 1) for trajectory in trajectories]
    samples = [
        ProgressSample(replace(trajectory, frames=cast(Any, trajectory.frames)[prefix.indices]))
        for trajectory, prefix in zip(trajectories, prefixes, strict=True)
    ]
    results = zip(evaluated(client, samples, config), prefixes, strict=True)
    newest = [result.at(slice(prefix.read, prefix.read + 1)) for result, prefix in results]
    for index, result in enumerate(newest):
        check_clear(result, 0, f"sample {index} of the batch")
    return newest


def scores_of_all_frames(
    client: RewardClient, trajectories: Sequence[Trajectory], config: RfmRewardConfig
) -> list[ProgressResult]:
    """Return the scores of every frame of each trajectory, [T], as ``newest_scores`` would at that frame.

    Costs a sample for each frame. Raises RewardError.
    """
    rule = rule_of(client.model_info(frames=True), config)
    results = iter(evaluated(client, chain.from_iterable(map(rule.samples, trajectories)), config))
    joined = [rule.joined(list(islice(results, trajectory.num_frames))) for trajectory in trajectories]
    for index, result in enumerate(joined):
        for frame in range(len(result.progress)):
            check_clear(result, frame, f"frame {frame} of sample {index}")
    return joined


def evaluated(client: RewardClient, samples: Iterable[ProgressSample], config: RfmRewardConfig) -> list[ProgressResult]:
    """Return the results of samples, in order, with the frames of a few samples in memory. Raises RewardError."""
    waiting, results = iter(samples), list[ProgressResult]()
    while some := list(islice(waiting, AT_A_TIME)):
        results += cast(list[ProgressResult], client.evaluate(some, resize=config.resize))
    return results


def check_clear(result: ProgressResult, slot: int, where: str) -> None:
    """Raise InferenceFailedError where a model that answers in words gave no single score."""
    if result.unclear is not None and result.unclear[slot]:
        raise InferenceFailedError(f"{where}: the model's written answer states no single score; no reward was made up")
