# SPDX-License-Identifier: MIT
"""Reference cases of reward models by LeRobot's and Robometer's code. RFM_REWARD_MODELS names a folder with more."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from paths import GOLDEN
from repositories import changing
from rfm_client import ProgressSample, Trajectory
from rfm_client.contract.description import DESCRIPTION_PARAMETER
from rfm_export.layout import description_in

ROOT = Path(os.environ.get("RFM_REWARD_MODELS") or GOLDEN / "reward_models")
BASE = ROOT / "bases" / "q3"


@dataclass(frozen=True)
class Reference:
    """A request and the answer. file: ``SECTION/CONFIG/cases/CASE.json``"""

    file: Path

    def __str__(self) -> str:
        return f"{self.config.name}/{self.file.stem}"

    @property
    def config(self) -> Path:
        return self.file.parents[1]

    @property
    def summary(self) -> dict[str, Any]:
        return dict(json.loads((self.config / "config_summary.json").read_text()))

    @property
    def content(self) -> dict[str, Any]:
        return dict(json.loads(self.file.read_text()))

    @property
    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        return dict(np.load(self.file.with_suffix("").with_suffix(".expected.npz")))

    def samples(self, last: int | None = None) -> list[ProgressSample]:
        """Return the request's samples. last: keep only the last N frames"""
        inputs = self.file.parent / self.content["inputs"]
        arrays = np.load(inputs.with_suffix(".npz"))
        samples = []
        for sample in json.loads(inputs.with_suffix(".json").read_text())["samples"]:
            trajectory = sample["trajectory"]
            frames = arrays[trajectory["frames"]["__numpy_file__"]]
            if frames.dtype != np.uint8:  # LeRobot multiplies floats in 0..1 by 255 and truncates
                frames = (frames * np.float32(255)).clip(0, 255).astype(np.uint8)
            samples.append(ProgressSample(Trajectory(frames=frames[-(last or 0) :], task=trajectory["task"])))
        return samples


def references(section: str) -> list[Reference]:
    return [Reference(file) for file in sorted((ROOT / section).glob("*/cases/*.json"))]


def as_before_marks(file: Path) -> None:
    """Remove the marks from a configuration, as in an export without them."""
    with changing(file.parent) as config:
        (unclear,) = (output for output in config.output if output.name == "unclear")
        config.output.remove(unclear)
        described = replace(description_in(config), more_scores=())
        config.parameters[DESCRIPTION_PARAMETER].string_value = described.to_json()
