# SPDX-License-Identifier: MIT
"""The reward model's configuration: the server, the frames in a batch, the reward."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from lerobot.configs.rewards import RewardModelConfig

from rfm_client import RewardClient
from rfm_client.episodes import SuccessRule
from rfm_client.frames import Correction, Orientation, Rule
from rfm_client.options import checked_count, checked_finite, require
from rfm_client.serving import DEFAULT_MODEL

OUTPUTS = ("progress", "success", "remaining_s")


@RewardModelConfig.register_subclass("rfm")
@dataclass
class RfmRewardConfig(RewardModelConfig):
    """Settings for a served reward model. Raises ValueError for invalid values.

    device: where LeRobot's preprocessor puts a batch; the network runs on the server
    url: server address, ``grpc://host:8001`` or ``http://host:8000``, with TLS ``grpcs://`` or ``https://``; for
        several servers, the addresses separated by spaces
    model: name under which the checkpoint was exported
    timeout_s: longest time for a call, retries included
    ca_file, client_certificate, client_key: as in ``RewardClient``
    api_key_file: file with the server's key. The key itself never enters the configuration, which LeRobot publishes
    image_key: the camera to score, ``observation.image`` or ``observation.images.<camera>``
    default_task: task for batches without one
    sampling, frames: as in ``client.episode``; None: as the checkpoint was trained
    orient: rotation or flip that makes the camera's frames upright
    resize: True: shrink frames to the checkpoint's input size before sending (needs Pillow)
    reward_output: the reward from ``compute_reward``: ``progress``, 0 to 1, ``success``, 1.0 or 0.0, or
        ``remaining_s``, minus the remaining seconds
    success_threshold: lowest probability that counts as ``success``
    """

    device: str | None = "cpu"
    url: str = "grpc://localhost:8001"
    model: str = DEFAULT_MODEL
    timeout_s: float = 60.0
    ca_file: str | None = None
    client_certificate: str | None = None
    client_key: str | None = None
    api_key_file: str | None = None
    image_key: str = "observation.images.top"
    default_task: str | None = None
    sampling: str | None = None
    frames: int | None = None
    orient: str = "none"
    resize: bool = False
    reward_output: str = "progress"
    success_threshold: float = SuccessRule.threshold

    def __post_init__(self) -> None:
        super().__post_init__()
        require("url", bool(self.url.split()), "the server's address, such as grpc://localhost:8001", repr(self.url))
        is_camera = self.image_key == "observation.image" or self.image_key.startswith("observation.images.")
        require("image_key", is_camera, "observation.image or observation.images.<camera>", repr(self.image_key))
        rules, turns = get_args(Rule), get_args(Orientation)
        require("sampling", self.sampling in (None, *rules), f"None or one of {', '.join(rules)}", repr(self.sampling))
        require("orient", self.orient in turns, f"one of {', '.join(turns)}", repr(self.orient))
        require(
            "reward_output", self.reward_output in OUTPUTS, f"one of {', '.join(OUTPUTS)}", repr(self.reward_output)
        )
        is_share = 0 <= checked_finite("success_threshold", self.success_threshold) <= 1
        require("success_threshold", is_share, "a probability, 0 to 1", self.success_threshold)
        if self.frames is not None:
            checked_count("frames", self.frames)

    @property
    def correction(self) -> Correction:
        """How to make the camera's frames upright."""
        return Correction(self.orient)  # type: ignore[arg-type]  # checked above; LeRobot's parser knows no Literal

    def connect(self) -> RewardClient:
        """Return a client for the server. Raises ValueError for contradictory options, OSError for a missing file."""
        key = None if self.api_key_file is None else Path(self.api_key_file).read_text().strip()
        return RewardClient(
            self.url.split(),
            model=self.model,
            timeout_s=self.timeout_s,
            ca_file=self.ca_file,
            client_certificate=self.client_certificate,
            client_key=self.client_key,
            api_key=key,
        )
