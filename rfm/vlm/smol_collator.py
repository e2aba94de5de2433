# SPDX-License-Identifier: MIT
"""The collator for SmolVLM, whose frames are squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from rfm.vlm.batch import FramesOfOneSize, SmolPixels, VlmBatch
from rfm.vlm.collator import VlmCollator
from rfm.vlm.images import SmolImages
from rfm.vlm.row import Spans, VlmRow
from rfm.vlm.video import Indices, VlmVideo

SMOL_IMAGE, GLOBAL_IMAGE, FAKE = "<image>", "<global-img>", "<fake_token_around_image>"


class SmolCollator(VlmCollator):
    """The collator for SmolVLM: images are image tokens between two FAKE tokens."""

    images: SmolImages

    def _to_size(self, video: VlmVideo, needed: Sequence[int]) -> Tensor:
        return self.images.images_to_size(video.stack(needed))

    def num_patches(self, video: VlmVideo) -> int:
        """Return the number of patches of all frames."""
        return video.num_shown * self.images.tokens * int(self.config.backbone["scale_factor"]) ** 2

    def _placed(self, text: str, videos: tuple[VlmVideo, ...]) -> tuple[str, str, list[int]]:
        text = text.replace(SMOL_IMAGE, FAKE + GLOBAL_IMAGE + SMOL_IMAGE + FAKE)
        return text, SMOL_IMAGE, [self.images.tokens] * sum(video.num_shown for video in videos)

    def _spans(self, ids: Indices, videos: tuple[VlmVideo, ...]) -> tuple[Spans, ...]:
        around = self._positions(ids, FAKE).tolist()
        return self._image_spans(ids, videos, list(zip(around[::2], around[1::2], strict=True)))

    def _with_pixels(self, batch: VlmBatch, rows: Sequence[VlmRow]) -> VlmBatch:
        """Add each conversation's squares; the frames of a video in several conversations are in the batch once."""
        firsts: dict[VlmVideo, int] = {}
        for video in (video for row in rows for video, _ in row.shown):
            if video not in firsts:
                firsts[video] = sum(len(each.frames) for each in firsts)
        frames = [np.concatenate([firsts[video] + shown for video, shown in row.shown]) for row in rows]
        counts = torch.tensor([len(each) for each in frames])
        pixels = SmolPixels(
            self.images,
            FramesOfOneSize([video.ready.pixels for video in firsts], None),
            rows=torch.arange(len(rows)).repeat_interleave(counts),
            places=torch.cat([torch.arange(count) for count in counts.tolist()]),
            frames=torch.from_numpy(np.concatenate(frames)),
            shape=(len(rows), int(counts.max())),
        )
        return replace(batch, pixels=pixels)
