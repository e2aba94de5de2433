# SPDX-License-Identifier: MIT
"""Synthetic samples, to check that a server answers."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import ClassVar, Literal, TypeAlias

import numpy as np

from rfm_client.client import RewardClient
from rfm_client.contract.errors import ModelNotFoundError
from rfm_client.contract.samples import PreferenceSample, ProgressSample, Sample, SimilaritySample, random_trajectory
from rfm_client.contract.settings import Settings, setting

TASK = "put the block in the bowl"

SampleType: TypeAlias = Literal["progress", "preference", "similarity"]


@dataclass(frozen=True)
class SyntheticSamples(Settings):
    """Synthetic samples: type, number, and trajectory length."""

    TITLE: ClassVar[str] = "Samples"

    sample_type: SampleType = setting("progress", "Type of the samples.")
    num_samples: int = setting(4, "Number of samples.", least=1, most=10_000)
    num_frames: int = setting(8, "Frames of a trajectory.", least=1, most=9999)
    use_frames: bool = setting(False, "Send random frames even if the model takes embeddings.")

    def samples(self, client: RewardClient) -> list[Sample]:
        """Return samples with the served checkpoint's widths. Raises ModelNotFoundError if no model takes them."""
        info = None
        if not self.use_frames:
            with suppress(ModelNotFoundError):
                info = client.model_info()
        widths = (info or client.model_info(frames=True)).widths
        random = np.random.default_rng(0)
        kinds = {"progress": ProgressSample, "preference": PreferenceSample, "similarity": SimilaritySample}
        count = 1 if self.sample_type == "progress" else 2
        return [
            kinds[self.sample_type](
                *(random_trajectory(random, self.num_frames, widths, task=TASK) for _ in range(count))
            )
            for _ in range(self.num_samples)
        ]


def are_frames(samples: list[Sample]) -> bool:
    """True if synthetic samples have raw frames."""
    return samples[0].trajectories[0].frames is not None
