# SPDX-License-Identifier: MIT
"""The reward model without weights: a server computes the rewards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
from lerobot.rewards.pretrained import PreTrainedRewardModel
from torch import Tensor

from lerobot_reward_rfm.batches import padding_of, trajectories_of
from lerobot_reward_rfm.configuration_rfm import RfmRewardConfig
from rfm_client import Float32Array, InferenceFailedError, RewardClient, Trajectory
from rfm_client.episodes import Episode
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
        output = self.config.reward_output
        with ExitStack() as stack:
            trajectories = enumerate(trajectories_of(batch, self.config))
            scores = self.client.score_episodes([stack.enter_context(self._episode(*each)) for each in trajectories])
        for index, score in enumerate(scores):
            check_clear(score.unclear, f"sample {index} of the batch")
        if output != "success":
            return self._tensor(batch, [score.value(cast(Any, output)) for score in scores])
        is_predicted = not any(np.isnan(score.success) for score in scores)
        require("reward_output", is_predicted, "progress", "success, which the checkpoint does not predict")
        return self._tensor(batch, [score.succeeded for score in scores])

    def predict_progress(self, batch: Mapping[str, Any]) -> RfmPrediction:
        """Return scores for all frames. No score uses later frames, so the last equals ``compute_reward``'s.

        The server scores B times T samples. Raises RewardError.
        """
        trajectories = trajectories_of(batch, self.config)
        rule = self.config.scoring.sampling_for(self.client.model_info(frames=True))
        results = [self.client.curve(each, rule, resize=self.config.resize) for each in trajectories]
        for index, result in enumerate(results):
            for frame in np.flatnonzero(result.arrays.get("unclear", ())):
                check_clear(True, f"frame {frame} of sample {index}")
        pads = padding_of(batch, self.config.image_key)
        progress = spread([result.progress for result in results], pads)
        success = spread([result.success for result in results], pads)
        knows = not np.isnan(success).any()
        return RfmPrediction(self._tensor(batch, progress), self._tensor(batch, success) if knows else None)

    def _episode(self, index: int, trajectory: Trajectory) -> Episode:
        """Return an episode with a sample's frames. index: the sample's, for errors"""
        options = self.config.scoring
        episode = self.client.episode(
            trajectory.task,
            env=index,
            sampling=options.sampling,
            frames=options.frames,
            resize=options.resize,
            success=options.success,
            score=options.score,
        )
        for frame in trajectory.positions:
            episode.keep(frame)
        return episode

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


def check_clear(is_unclear: bool, where: str) -> None:
    """Raise InferenceFailedError where a model that answers in words gave no single score."""
    if is_unclear:
        raise InferenceFailedError(f"{where}: the model's written answer states no single score; no reward was made up")
