# SPDX-License-Identifier: MIT
"""TOPReward's settings, prompts and frames, as in LeRobot and in Robometer's baseline.

Sources: ``lerobot/rewards/topreward`` in LeRobot, July 2026; ``robometer/evals/baselines/topreward.py``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, TypeAlias

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from rfm.qwen.batch import VlmRow
from rfm.qwen.images import (
    FRAMES_PER_GROUP,
    MERGE,
    Grid,
    QwenImages,
    bounded_size,
    resized,
    scaled_in_integers,
    scaled_video,
)
from rfm.qwen.language import LanguageCollator, LanguageConfig
from rfm.qwen.video import Indices, VlmVideo
from rfm_client.contract import InvalidSampleError, Sample
from rfm_client.contract.checks import require

Variant: TypeAlias = Literal["lerobot", "robometer"]
PROMPT_PREFIX = "The above video shows a robot manipulation trajectory that completes the following task: "
PROMPT_SUFFIX = "{instruction} Decide whether the above statement is True or not. The answer is: True"
ANSWER = "True"
# Robometer's baseline: its processor assumes 24 frames per second for every video, and samples 2 per second.
ASSUMED_FPS, SAMPLED_FPS, LEAST_SAMPLED = 24, 2, 4
SIDES_PX = (224, 336, 320)  # successive frame sizes, after Pillow, qwen-vl-utils and the processor


@dataclass(frozen=True)
class TopRewardConfig(LanguageConfig):
    """The configuration of TOPReward.

    variant: whose code it follows
    chat_template: the answer stands behind the chat template's generation prompt; otherwise behind the question
    prompt_prefix, prompt_suffix: text behind the video; the suffix has ``{instruction}`` and ends with the answer
    fps: frames per second, from which LeRobot's variant writes times; Robometer's ignores it
    num_prefixes: most prefixes to score, evenly spaced; frames between them are interpolated; None: all
    max_frames: most frames per episode
    least_px, most_px: per video, over all frames, in LeRobot's variant
    """

    variant: Variant
    chat_template: bool
    fps: float
    num_prefixes: int | None
    max_frames: int
    least_px: int
    most_px: int
    prompt_prefix: str = PROMPT_PREFIX
    prompt_suffix: str = PROMPT_SUFFIX

    reward_model: ClassVar[str] = "topreward"

    def prefixes(self, num_frames: int) -> Indices:
        """Return the frame counts of the prefixes to score, int64."""
        if self.variant == "robometer":
            if num_frames <= FRAMES_PER_GROUP:
                return np.array([num_frames])
            return np.linspace(1, num_frames, min(self.num_prefixes or num_frames, num_frames), dtype=np.int64)
        if self.num_prefixes is None:
            return np.arange(1, num_frames + 1)
        return np.unique(np.linspace(1, num_frames, self.num_prefixes).round().astype(np.int64))

    def shown(self, length: int) -> tuple[Indices, list[float]]:
        """Return the prefix frames that the model sees, int64, and each pair's mean time in seconds."""
        if self.variant == "lerobot":
            shown = np.arange(length)
            times_s = [frame / self.fps for frame in shown.tolist()]
        else:
            filled = np.minimum(np.arange(length + length % FRAMES_PER_GROUP), length - 1)
            wanted = max(int(len(filled) / ASSUMED_FPS * SAMPLED_FPS), LEAST_SAMPLED)
            kept = np.linspace(0, len(filled) - 1, min(wanted, len(filled))).round().astype(np.int64)
            shown, times_s = filled[kept], [frame / ASSUMED_FPS for frame in kept.tolist()]
        times_s = [*times_s, *times_s[-1:] * (len(times_s) % FRAMES_PER_GROUP)]
        return shown, [(first + last) / 2 for first, last in zip(times_s[::2], times_s[1::2], strict=True)]


@dataclass(frozen=True)
class TopRewardImages(QwenImages):
    """The preprocessing of videos, in both variants."""

    config: TopRewardConfig = field(kw_only=True)

    def size(self, height: int, width: int, num_frames: int) -> tuple[int, int]:
        """Return the height and width for a prefix's frames. Raises InvalidSampleError for small frames."""
        factor = self.patch_px * MERGE
        if self.config.variant == "robometer":
            return SIDES_PX[1], SIDES_PX[1]
        expected = f"frames of at least {factor} x {factor} pixels"
        require("frames", min(height, width) >= factor, expected, f"{height} x {width}", InvalidSampleError)
        num_filled = math.ceil(num_frames / FRAMES_PER_GROUP) * FRAMES_PER_GROUP
        bounds_px = self.config.least_px, self.config.most_px
        return bounded_size(height, width, factor, bounds_px, num_frames, num_filled)

    def grid(self, groups: int, height: int, width: int) -> Grid:
        """Return the grid for ``groups`` temporal patches whose frames have this size in pixels."""
        if self.config.variant == "robometer":
            height = width = SIDES_PX[-1]
        return super().grid(groups, height, width)

    def patches(self, frames: Tensor, shots: Tensor | None, dtype: torch.dtype = torch.float32) -> Tensor:
        """Cut frames into patches, as ``QwenImages`` does; Robometer's variant first resizes them in float."""
        if self.config.variant == "robometer":
            planes = frames.movedim(-1, 1).float()
            planes = F.interpolate(planes, (SIDES_PX[-1], SIDES_PX[-1]), mode="bicubic", antialias=True)
            frames = planes.movedim(1, -1)
        return super().patches(frames, shots, dtype)


class TopRewardCollator(LanguageCollator):
    """The collator for TOPReward: one conversation per trajectory prefix."""

    images: TopRewardImages
    config: TopRewardConfig  # no heads, so no VlmConfig

    def rows(self, sample: Sample) -> list[VlmRow]:
        """Return the conversations for a progress sample. Raises InvalidSampleError."""
        frame_steps = getattr(sample, "frame_steps", 0)
        if frame_steps:
            expected = "0 (TOPReward's progress is relative to the whole episode; for each step there is log_prob)"
            raise InvalidSampleError.at("frame_steps", expected, str(frame_steps))
        num_frames, most = sample.trajectories[0].num_frames, self.config.max_frames
        if num_frames > most:
            raise InvalidSampleError.at("num_frames", f"at most {most} (max_frames of this model)", str(num_frames))
        return super().rows(sample)

    def prompts(self, video: VlmVideo, task: str) -> list[VlmRow]:
        """Return a conversation for every prefix to score. Prefixes with equal frame sizes share the resized frames."""
        text = self.text(task)
        of_prefixes = [self.config.shown(int(length)) for length in self.config.prefixes(len(video.frames))]
        sizes = [self.images.size(*video.size, len(shown)) for shown, _ in of_prefixes]
        videos = {}
        for size in dict.fromkeys(sizes):
            conversations = [
                shown for (shown, _), of_prefix in zip(of_prefixes, sizes, strict=True) if of_prefix == size
            ]
            end = 1 + max(int(shown.max()) for shown in conversations)
            named = None if video.named is None else video.named[:end]
            videos[size] = VlmVideo(video.frames[:end], len(conversations[-1]), conversations, named)
        prefixes = zip(of_prefixes, sizes, strict=True)
        return [self.row(videos[size], text, shown, times_s) for (shown, times_s), size in prefixes]

    def example(self) -> str:
        """Return the prompt for an example task, with VIDEO as placeholder."""
        return self.text("TASK")

    def text(self, task: str) -> str:
        """Return the prompt, with VIDEO as placeholder, and the answer at its end."""
        statement = self.config.prompt_suffix.format(instruction=task)
        if not self.config.chat_template:
            question = self.template(self.config.prompt_prefix, add_generation_prompt=False)
            return question.partition(self.tokenizer.eos_token)[0] + statement
        question = self.config.prompt_prefix + statement.removesuffix(ANSWER).rstrip()
        return self.template(question, add_generation_prompt=True) + ANSWER

    def row(
        self, video: VlmVideo, text: str, shown: Indices, times_s: Sequence[float], more: Indices | tuple[int, ...] = ()
    ) -> VlmRow:
        """Return the conversation whose query is the token before the answer."""
        row = super().row(video, text, shown, times_s, more)
        return replace(row, query=row.num_tokens - 2)

    def grid(self, video: VlmVideo) -> Grid:
        """Return the grid for the longest conversation about a video."""
        size = self.images.size(*video.size, video.num_shown)
        return self.images.grid(math.ceil(video.num_shown / FRAMES_PER_GROUP), *size)

    def _to_size(self, video: VlmVideo, needed: Sequence[int]) -> Tensor:
        frames = video.stack(needed)
        size = self.images.size(*video.size, video.num_shown)
        if self.config.variant == "robometer":
            side = SIDES_PX[0]
            small = [resized(frame, side, side) for frame in frames]
            frames = np.stack(small) if small else np.empty((0, side, side, 3), np.uint8)
        pixels = torch.from_numpy(frames if frames.flags.writeable else frames.copy())
        if self.config.variant == "robometer":
            return scaled_video(pixels, size)
        return scaled_in_integers(pixels, size)
