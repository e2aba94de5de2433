# SPDX-License-Identifier: MIT
"""Reference cases of Robo-Dopamine by the original code, and by Robometer's baseline."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from engines import asked_engine
from reward_models import ROOT, Reference
from rfm.engine import Engine
from rfm.families.robodopamine.prompts import parsed
from rfm_client import ProgressSample, Trajectory

FOLDER = ROOT / "robodopamine"
CHECKPOINT = FOLDER / "grm_qwen3vl_bf16_tied" / "checkpoint"


@dataclass(frozen=True)
class Case(Reference):
    """A run of the original, or of Robometer's baseline."""

    @property
    def request(self) -> dict[str, Any]:
        inputs = self.file.parent / self.content["inputs"]
        return dict(json.loads(inputs.with_suffix(".json").read_text()))

    @property
    def is_baseline(self) -> bool:
        return self.file.stem.startswith("baseline")

    @property
    def sample(self) -> ProgressSample:
        request = self.request
        arrays = np.load((self.file.parent / self.content["inputs"]).with_suffix(".npz"))
        front = arrays["frames" if self.is_baseline else "cam_high"]
        views = [arrays[name] for name in ("cam_left_wrist", "cam_right_wrist") if name in arrays]
        goal = arrays["goal_image"] if "goal_image" in arrays else front[-1]  # the original's, without a picture
        return ProgressSample(
            Trajectory(frames=front, task=request["task"], views=tuple(views), goal=None if self.is_baseline else goal)
        )

    @property
    def said(self) -> str:
        """The argument of ``--as`` with this case's settings."""
        return f"robodopamine,mode={self.request['eval_mode']},interval={self.request['frame_interval']}"

    def engine(self, dtype: torch.dtype | None = None) -> Engine:
        return asked_engine(self.config / "checkpoint", self.said, dtype)


CASES = [Case(file) for file in sorted(FOLDER.glob("*/cases/*.json"))]
ANSWERED = [case for case in CASES if case.content["calls"]]
READABLE = [case for case in ANSWERED if all(parsed(call["text"]) is not None for call in case.content["calls"])]


def case_named(name: str) -> Case:
    return next(case for case in CASES if str(case) == f"grm_qwen3vl_bf16_tied/{name}")
