# SPDX-License-Identifier: MIT
"""Frames made as small as the checkpoint reads them, before they travel. Needs Pillow: ``rfm-client[resize]``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, TypeAlias, cast

import numpy as np

from rfm_client.samples import UInt8Array

Rule: TypeAlias = Literal["shortest", "longest", "exact"]

_FORMS = "'shortest PX', 'longest PX' or 'exact HEIGHTxWIDTH'"
_TEXT = re.compile(r"(?:(shortest|longest) ([1-9][0-9]*))|(?:(exact) ([1-9][0-9]*)x([1-9][0-9]*))")


@dataclass(frozen=True)
class FrameSize:
    """To what size a served checkpoint brings every frame before it reads it.

    rule: ``shortest``, as ReWiND's encoders: that edge to so many pixels, the other in proportion, rounded down;
        ``longest``, as SmolVLM: that edge, the other in proportion and even;
        ``exact``: height and width
    edges_px: (px,), or (height, width) of ``exact``
    """

    rule: Rule
    edges_px: tuple[int, ...]

    @classmethod
    def parse(cls, text: str) -> FrameSize:
        """From ``shortest 256``, ``longest 512`` or ``exact 224x320``; ``str`` gives it back. Raises ValueError."""
        match = _TEXT.fullmatch(text)
        if match is None:
            raise ValueError(f"frame_size: expected {_FORMS}, got {text!r}")
        rule, *edges = (part for part in match.groups() if part)
        return cls(cast(Rule, rule), tuple(map(int, edges)))

    def __str__(self) -> str:
        return f"{self.rule} {'x'.join(map(str, self.edges_px))}"

    def fitted(self, height: int, width: int) -> tuple[int, int]:
        """Height and width to which frames of this size are brought; never larger, so the server does the enlarging."""
        if self.rule == "exact":
            return min(height, self.edges_px[0]), min(width, self.edges_px[1])
        (px,) = self.edges_px
        edge = min(height, width) if self.rule == "shortest" else max(height, width)
        if edge <= px:
            return height, width
        # The very expressions of the server: one that rounds otherwise would have it resize once more.
        if self.rule == "shortest":
            other = int(px * max(height, width) / edge)
            return (px, other) if height <= width else (other, px)
        other = int(px / (width / height)) if width >= height else int(px * (width / height))
        other = max(other + other % 2, 1)
        return (other, px) if width >= height else (px, other)


def resize_frames(frames: UInt8Array, size: FrameSize) -> UInt8Array:
    """uint8 [T, H, W, 3], as small as a checkpoint of this frame size reads them; the same array if they are.

    Resized by Pillow: bicubic, but ``longest`` Lanczos, as SmolVLM. What the network then reads is for SmolVLM the
    same to the bit, for ReWiND within one grey level. Qwen's backbones read the same if ``exact`` is the size that
    they read; if they round it to whole patches, frames are resized twice, and single pixels differ by up to 15.
    """
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError('resizing frames needs Pillow: pip install "./client[resize]"') from error
    height, width = size.fitted(frames.shape[1], frames.shape[2])
    if (height, width) == frames.shape[1:3]:
        return frames
    resample = Image.Resampling.LANCZOS if size.rule == "longest" else Image.Resampling.BICUBIC
    resized = np.empty((len(frames), height, width, 3), np.uint8)
    for frame, smaller in zip(frames, resized, strict=True):
        smaller[:] = Image.fromarray(frame).resize((width, height), resample)
    return resized
