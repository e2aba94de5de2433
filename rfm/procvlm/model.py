# SPDX-License-Identifier: MIT
"""ProcVLM's written progress, as ``evqa/inference.py`` of ``ProcVLM/ProcVLM`` describes it. No numbers of the original
code have been compared: no reference data exist. The value head, which the original leaves out by default, is not read.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from rfm.engine.execution import Execution
from rfm.engine.pixels import Normalisation
from rfm.engine.predictor import RowScores, check_type, no_success
from rfm.vlm.asked_images import ImagesCheckpoint, ImagesCollator, ImagesConfig, each_alone
from rfm.vlm.collator import video_of
from rfm.vlm.images import QwenImages
from rfm.vlm.row import VlmRow
from rfm.vlm.written import WritingPredictor, WrittenAnswer, progress_of
from rfm_client.contract import FrameScores, InvalidSampleError, Sample
from rfm_client.contract.description import Description

PROMPT = (
    'Given the recent observation and the task "{task}", first infer the remaining atomic actions required to complete '
    "the task. Then estimate the current completion percentage and output it as a float wrapped by <progress> tags."
)
SHOWN_FRAMES = 8
UNVERIFIED = "ProcVLM: the scores have not been compared with the original code"
_PROGRESS = re.compile(r"<progress>\s*([+-]?\d+(?:\.\d+)?)\s*%?\s*</progress>", re.IGNORECASE)


def parsed(answer: str) -> float | None:
    """Return progress in an answer, 0..1, from its first tag; None: it holds none."""
    found = _PROGRESS.search(answer)
    return None if found is None else max(0.0, min(100.0, float(found[1]))) / 100


@dataclass(frozen=True)
class ProcVlmConfig(ImagesConfig):
    """The configuration of ProcVLM."""

    max_new_tokens: int = 4096  # as the original

    reward_model: ClassVar[str] = "procvlm"


class ProcVlmCollator(ImagesCollator):
    """The collator of ProcVLM: for each frame a conversation about the eight frames that end there."""

    num_images = SHOWN_FRAMES

    def example(self) -> str:
        """Return the prompt of an example task."""
        return self.rendered([*[None] * SHOWN_FRAMES, PROMPT.replace("{task}", "TASK")])

    def rows(self, sample: Sample) -> list[VlmRow]:
        """Return the conversations of a progress sample, one for each frame. Raises InvalidSampleError."""
        check_type(sample, self.config)
        (trajectory,) = sample.trajectories
        self._check_task(trajectory.task)
        if steps := getattr(sample, "frame_steps", 0):
            expected = f"0 (ProcVLM scores each frame on the {SHOWN_FRAMES} that end there)"
            raise InvalidSampleError.at("frame_steps", expected, str(steps))
        video = video_of(trajectory, 0)
        shown = each_alone(video.frames, np.arange(trajectory.num_frames), video.named)
        back = np.arange(1 - SHOWN_FRAMES, 1)
        asked = [[(shown, frame) for frame in (t + back).clip(min=0).tolist()] for t in range(trajectory.num_frames)]
        text = self.rendered([*[None] * SHOWN_FRAMES, PROMPT.replace("{task}", trajectory.task)])
        return self.questions(text, asked)


class ProcVlmPredictor(WritingPredictor):
    """A Qwen3-VL on a device, which writes its thoughts and progress."""

    expected = "progress in percent, as <progress>84%</progress>, in the model's answer"

    def read(self, text: str, answer: WrittenAnswer, row: VlmRow, execution: Execution) -> RowScores | None:
        """Return progress in an answer; None: it cannot be read."""
        progress = parsed(text)
        return None if progress is None else progress_of(progress)

    def joined(self, sample: Sample, rows: Sequence[RowScores]) -> FrameScores:
        """Return the scores of all frames."""
        progress = np.array([row.frames[0].progress[0] for row in rows], np.float32)
        return FrameScores(progress=progress, success=no_success(progress))


@dataclass(frozen=True)
class ProcVlmCheckpoint(ImagesCheckpoint):
    """A ProcVLM in memory."""

    made_of = ProcVlmConfig
    made_for = ProcVlmPredictor
    of_user: ClassVar[dict[str, type]] = {"max_new_tokens": int}
    notes: ClassVar[list[str]] = [UNVERIFIED]  # a line for each export

    @property
    def description(self) -> Description:
        """The model's inputs and outputs."""
        return replace(super().description, kind="ProcVLM (unverified)")

    def make_collator(self, tokenizer: Any, patch_px: int, normalisation: Normalisation) -> ProcVlmCollator:
        """Return the collator with this tokenizer and preprocessing."""
        return ProcVlmCollator(self.config, tokenizer, QwenImages(patch_px, normalisation), draft="")
