# SPDX-License-Identifier: MIT
"""Frames made as small as the checkpoint reads them, before they travel. Needs Pillow: ``rfm-client[resize]``."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from rfm_client.contract.frame_size import FrameSize
from rfm_client.contract.samples import UInt8Array

JPEG_QUALITY = 85


def load_pillow() -> Any:
    """Pillow's ``Image``. Raises ImportError, which says how to install it."""
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError('making frames smaller needs Pillow: pip install "./client[resize]"') from error
    return Image


def as_jpeg(frame: UInt8Array, longest_px: int) -> bytes:
    """A frame, uint8 [H, W, 3], as a JPEG file. Its longer side has at most ``longest_px`` pixels."""
    image = load_pillow().fromarray(frame)
    image.thumbnail((longest_px, longest_px))
    file = io.BytesIO()
    image.save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)  # colours as sharp as the rest
    return file.getvalue()


def resize_frames(frames: UInt8Array, size: FrameSize) -> UInt8Array:
    """uint8 [T, H, W, 3], as small as a checkpoint of this frame size reads them; the same array if they are.

    Resized by Pillow: bicubic, but ``longest`` Lanczos, as SmolVLM. What the network then reads is for SmolVLM the
    same to the bit, for ReWiND within a grey level or two. Qwen's backbones read the same if ``exact`` is the size that
    they read; if they round it to whole patches, frames are resized twice, and single pixels differ by up to 15.
    """
    Image = load_pillow()  # noqa: N806  as Pillow writes it
    height, width = size.fitted(frames.shape[1], frames.shape[2])
    if (height, width) == frames.shape[1:3]:
        return frames
    resample = Image.Resampling.LANCZOS if size.rule == "longest" else Image.Resampling.BICUBIC
    resized = np.empty((len(frames), height, width, 3), np.uint8)
    for frame, smaller in zip(frames, resized, strict=True):
        smaller[:] = Image.fromarray(frame).resize((width, height), resample)
    return resized
