# SPDX-License-Identifier: MIT
"""A frame scorer for LeRobot's offline scoring of datasets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from lerobot_reward_rfm.batches import as_configured
from lerobot_reward_rfm.modeling_rfm import RfmRewardModel
from lerobot_reward_rfm.prefixes import rule_of, scores_of_all_frames
from rfm_client import Trajectory, as_trajectory
from rfm_client.options import is_blank

PROGRESS, SUCCESS = "reward.rfm.progress", "reward.rfm.success_probability"
MEANINGS = {
    PROGRESS: "Share of the task that is done, from the frames up to this one.",
    SUCCESS: "Probability that the task is done, from the frames up to this one.",
}


@dataclass(frozen=True)
class RfmFrameScorer:
    """A scorer of whole episodes for ``lerobot.rewards.scoring.score_dataset``.

    Each frame is scored on the frames up to it alone. Raises ImportError for a LeRobot without offline scoring.
    """

    model: RfmRewardModel

    def __post_init__(self) -> None:
        scoring_types()

    @property
    def options(self) -> dict[str, Any]:
        """What decides the scores, for the ``provenance`` of ``score_dataset``: settings and checkpoint."""
        config, info = self.model.config, self.model.client.model_info(frames=True)
        rule = asdict(rule_of(info, config))
        own = {name: getattr(config, name) for name in ("image_key", "default_task", "orient", "resize")}
        checkpoint = {name: getattr(info, name) for name in ("name", "source", "revision", "weights_digest")}
        return {"sampling": rule["rule"], "frames": rule["frames"], **own, "checkpoint": checkpoint}

    def __call__(self, dataset: Any, episode_index: int) -> Any:
        """Return the FrameSignals of an episode of a LeRobotDataset. Raises RewardError, never a number instead."""
        signals, descriptor = scoring_types()
        trajectory = self._trajectory(dataset, episode_index)
        (result,) = scores_of_all_frames(self.model.client, [trajectory], self.model.config)
        found = {PROGRESS: result.progress, SUCCESS: result.success}
        known = {name: np.array(values, np.float32) for name, values in found.items() if not np.isnan(values).any()}
        return signals(
            frame_indices=np.arange(trajectory.num_frames, dtype=np.int64),
            signals=known,
            descriptors={
                name: descriptor(description=MEANINGS[name], direction="higher", bounds=(0.0, 1.0)) for name in known
            },
        )

    def _trajectory(self, dataset: Any, episode_index: int) -> Trajectory:
        config = self.model.config
        first = next(steps_of(dataset, episode_index))
        task = config.default_task if config.default_task and is_blank(first.get("task")) else ""
        trajectory = as_trajectory(steps_of(dataset, episode_index), task=task, camera=config.camera)
        return as_configured(trajectory, config)


def steps_of(dataset: Any, episode_index: int) -> Iterator[Mapping[str, Any]]:
    """Yield the frames of an episode, also of a dataset opened with some episodes alone."""
    episode = dataset.meta.episodes[episode_index]
    places = getattr(dataset, "absolute_to_relative_idx", None)
    for index in range(int(episode["dataset_from_index"]), int(episode["dataset_to_index"])):
        yield dataset[index if places is None else places[index]]


def scoring_types() -> tuple[Any, Any]:
    """Return LeRobot's FrameSignals and SignalDescriptor. Raises ImportError."""
    try:
        from lerobot.rewards.scoring import FrameSignals, SignalDescriptor
    except ImportError as error:
        raise ImportError(
            "lerobot.rewards.scoring: expected a LeRobot with offline scoring of datasets, got one without it; "
            "label the dataset with `rfm-client label` instead (pip install ./apps/labels)"
        ) from error
    return FrameSignals, SignalDescriptor
