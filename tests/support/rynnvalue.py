# SPDX-License-Identifier: MIT
"""Reference cases of RynnValue by the original code."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from reward_models import ROOT, Reference
from rfm import published
from rfm.engine import Engine
from rfm_client import ProgressSample, Trajectory

FOLDER = ROOT / "rynnvalue"
FRAME_STEPS = 8  # of the original's server
RELATIVE_TOLERANCE = 2e-4  # of seconds, relative and absolute
ISOLATED = "pred_slot_isolated_eager"
# The original's table of descriptions of robot and camera, for a request without them.
SOURCES = {"usc_xarm_policy_ranking": ("an xArm single-arm robot", "the main right camera")}
USUAL = ("a Franka single-arm robot", "the main right camera")
UNSAID = (None, None)

Meta = tuple[str | None, str | None]


@dataclass(frozen=True)
class Asked:
    """One sample of a case, and the engine of an export with its descriptions of robot and camera.

    prefix: of its arrays
    """

    sample: ProgressSample
    prefix: str
    checkpoint: Path
    meta: Meta

    @property
    def engine(self) -> Engine:
        return engine_of(self.checkpoint, self.meta)


@dataclass(frozen=True)
class Case(Reference):
    """A request and the answer."""

    @property
    def checkpoint(self) -> Path:
        return self.config / "checkpoint"

    @property
    def attention(self) -> str:
        return str(self.summary["attn_implementation_in_config_json"])

    def expected(self, prefix: str, name: str) -> npt.NDArray[np.float32]:
        """The original's numbers in float32, [N]: the mean of all heads."""
        rounded = "fp32." if self.summary["dtype"] == "bfloat16" else ""
        array = self.arrays[f"{prefix}{rounded}{self.attention}.{name}"]
        return array.mean(0) if name.startswith("value") else array.reshape(-1)

    def asked(self) -> list[Asked]:
        inputs = self.file.parent / self.content["inputs"]
        request, arrays = json.loads(inputs.with_suffix(".json").read_text()), np.load(inputs.with_suffix(".npz"))
        found = []
        for index, sample in enumerate(request["samples"]):
            trajectory = sample["trajectory"]
            if not trajectory["task"]:
                continue  # a sample of ours needs a task
            frames = np.clip(arrays[trajectory["frames"]["__numpy_file__"]], 0, 255).astype(np.uint8)
            steps = FRAME_STEPS if request["use_frame_steps"] else 0
            told = trajectory.get("metadata")
            meta = (
                (told.get("robot_description"), told.get("camera_description"))
                if told
                else SOURCES[trajectory["data_source"]]
            )
            shown = ProgressSample(Trajectory(frames=frames, task=trajectory["task"]), steps)
            meta = meta if self.summary["use_meta"] else UNSAID
            found.append(Asked(shown, f"sample_{index}.", self.checkpoint, meta))
        return found


def said(meta: Meta) -> dict[str, str | None]:
    """The options of an export with these descriptions."""
    return dict(zip(("robot_description", "camera_description"), meta, strict=True))


@lru_cache(maxsize=8)
def engine_of(checkpoint: Path, meta: Meta) -> Engine:
    return Engine.of(published.load(checkpoint, **said(meta)))


CASES = [Case(file) for file in sorted(FOLDER.glob("*/cases/*.json"))]
