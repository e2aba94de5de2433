# SPDX-License-Identifier: MIT
"""The reward model without weights: a server computes the rewards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
from lerobot.rewards.pretrained import PreTrainedRewardModel
from torch import Tensor

from lerobot_reward_rfm.batches import padding_of, trajectories_of
from lerobot_reward_rfm.configuration_rfm import OUTPUTS, RfmRewardConfig
from rfm_client import (
    Float32Array,
    InferenceFailedError,
    ModelInfo,
    ProgressResult,
    ProgressSample,
    RewardClient,
    Trajectory,
)
from rfm_client.frames import Sampling
from rfm_client.options import require


@dataclass(frozen=True)
class RfmPrediction:
    """Scores for the frames in a batch.

    progress: float32 [B, T], 0 to 1
    success_probability: float32 [B, T]; None: the checkpoint does not predict success
    """

    progress: Tensor
    success_probability: Tensor | None


class RfmRewardModel(PreTrainedRewardModel):
    """A LeRobot reward model whose network runs on a server. Only a configuration is saved.

    client: your client, which the model never closes; None: the model makes one at its first call, and so does each
        copy of the model

    A batch has images under the configuration's ``image_key``: uint8, or float in 0..1, [B, T, 3, H, W], the newest
    frame last, or [B, 3, H, W], one frame per sample; on any device. ``task`` is one sentence, or one per sample.
    Frames that LeRobot marks as padding (``<image_key>_is_pad``) repeat a neighbour: the network never sees them, and
    they get the neighbour's score.
    """

    config_class = RfmRewardConfig
    name = "rfm"

    def __init__(self, config: RfmRewardConfig, client: RewardClient | None = None, **_: Any) -> None:
        super().__init__(config)
        self._given = client
        self._made: RewardClient | None = None

    @property
    def client(self) -> RewardClient:
        """The client that talks to the server."""
        if self._given is not None:
            return self._given
        made = self._made
        if made is None:
            made = self._made = self.config.connect()
        return made

    def close(self) -> None:
        """Close the client that the model made. The next call makes another."""
        made, self._made = self._made, None
        if made is not None:
            made.close()

    def __getstate__(self) -> dict[str, Any]:
        if self._given is not None:
            raise TypeError(
                "RfmRewardModel: expected no client of yours in a model to copy or pickle, got one, which stays in its "
                "process; name its server in the configuration instead"
            )
        return {**self.__dict__, "_made": None}

    def compute_reward(self, batch: Mapping[str, Any]) -> Tensor:
        """Return each sample's reward at the newest frame, float32 [B], on the images' device.

        The Gymnasium wrappers and labels give the same reward for the same frames. Raises RewardError, never returns a
        number instead; ValueError for a ``reward_output`` that the checkpoint does not predict.
        """
        newest = newest_scores(self.client, trajectories_of(batch, self.config), self.config)
        output = self.config.reward_output
        columns = {name: [each.arrays.get(name, [np.nan])[0] for each in newest] for name in OUTPUTS}
        predicted = [name for name, scores in columns.items() if not np.isnan(scores).any()]
        got = f"{output}, which the checkpoint does not predict"
        require("reward_output", output in predicted, " or ".join(predicted) or "a checkpoint that scores frames", got)
        scores = np.array(columns[output])
        if output == "success":
            return self._tensor(batch, scores >= self.config.success_threshold)
        return self._tensor(batch, -scores if output == "remaining_s" else scores)

    def predict_progress(self, batch: Mapping[str, Any]) -> RfmPrediction:
        """Return scores for all frames. No score uses later frames, so the last equals ``compute_reward``'s.

        Raises RewardError.
        """
        trajectories = trajectories_of(batch, self.config)
        results = scores_of_all_frames(self.client, trajectories, self.config)
        pads = padding_of(batch, self.config.image_key)
        progress = spread([result.progress for result in results], pads)
        success = spread([result.success for result in results], pads)
        knows = not np.isnan(success).any()
        return RfmPrediction(self._tensor(batch, progress), self._tensor(batch, success) if knows else None)

    def _tensor(self, batch: Mapping[str, Any], values: Sequence[float] | npt.NDArray[Any]) -> Tensor:
        device = getattr(batch[self.config.image_key], "device", None)
        place = device if isinstance(device, torch.device) else None
        return torch.tensor(np.asarray(values, np.float32), dtype=torch.float32, device=place)


RfmRewardRewardModel = RfmRewardModel  # the name that LeRobot derives from RfmRewardConfig


def spread(scores: Sequence[Float32Array], pads: npt.NDArray[np.bool_] | None) -> Float32Array:
    """Return float32 [B, T] from the scores of real frames: padding gets the score of the frame that it repeats."""
    if pads is None:
        return np.stack(scores)
    real = np.maximum(np.cumsum(~pads, axis=1) - 1, 0)
    return np.stack([row[slots] for row, slots in zip(scores, real, strict=True)])


def rule_of(info: ModelInfo, config: RfmRewardConfig) -> Sampling:
    """Return the sampling rule. Raises ValueError if the rule needs a number and has none.

    Raises InvalidSampleError for a checkpoint that cannot score while an episode runs.
    """
    info.check_scores_prefixes()
    rule = cast(Any, config.sampling)
    return Sampling.of(rule, config.frames, info.max_frames, trained_padding=info.trained_padding)


def newest_scores(
    client: RewardClient, trajectories: Sequence[Trajectory], config: RfmRewardConfig
) -> list[ProgressResult]:
    """Return the newest frame's scores for each trajectory, [1], from few requests. Raises RewardError."""
    rule = rule_of(client.model_info(frames=True), config)
    prefixes = [rule.prefix(trajectory.num_frames - 1) for trajectory in trajectories]
    samples = [
        ProgressSample(replace(trajectory, frames=cast(Any, trajectory.frames)[prefix.indices]))
        for trajectory, prefix in zip(trajectories, prefixes, strict=True)
    ]
    results = zip(cast(list[ProgressResult], client.evaluate(samples, resize=config.resize)), prefixes, strict=True)
    newest = [result.at(slice(prefix.read, prefix.read + 1)) for result, prefix in results]
    for index, result in enumerate(newest):
        check_clear(result, 0, f"sample {index} of the batch")
    return newest


def scores_of_all_frames(
    client: RewardClient, trajectories: Sequence[Trajectory], config: RfmRewardConfig
) -> list[ProgressResult]:
    """Return scores for every frame of each trajectory, [T], as ``newest_scores`` would at that frame.

    Raises RewardError.
    """
    rule = rule_of(client.model_info(frames=True), config)
    curves = [client.curve(trajectory, rule, resize=config.resize) for trajectory in trajectories]
    for index, result in enumerate(curves):
        for frame in range(len(result.progress)):
            check_clear(result, frame, f"frame {frame} of sample {index}")
    return curves


def check_clear(result: ProgressResult, slot: int, where: str) -> None:
    """Raise InferenceFailedError where a model that answers in words gave no single score."""
    if result.unclear is not None and result.unclear[slot]:
        raise InferenceFailedError(f"{where}: the model's written answer states no single score; no reward was made up")
