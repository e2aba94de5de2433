# SPDX-License-Identifier: MIT
"""Shrink frames to the size that the checkpoint reads, before they travel. Needs Pillow: ``rfm-client[resize]``."""

from __future__ import annotations

from typing import Any

import numpy as np

from rfm_client.contract.frame_size import FrameSize
from rfm_client.contract.samples import UInt8Array


def load_pillow() -> Any:
    """Return Pillow's ``Image``. Raises ImportError with the extra to install."""
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError('making frames smaller needs Pillow: pip install "./client[resize]"') from error
    return Image


def resize_frames(frames: UInt8Array, size: FrameSize) -> UInt8Array:
    """Return frames, uint8 [T, H, W, 3], no larger than the checkpoint reads them; the same array if they fit.

    Pillow resizes, bicubic. The network's input stays within a grey level or two for ReWiND. For Qwen's backbones it
    stays identical if they read the size ``exact``. If they round it to whole patches, frames are resized twice, and
    single pixels differ by up to 15.
    """
    Image = load_pillow()  # noqa: N806  Pillow's spelling
    height, width = size.fitted(frames.shape[1], frames.shape[2])
    if (height, width) == frames.shape[1:3]:
        return frames
    resized = np.empty((len(frames), height, width, 3), np.uint8)
    for frame, smaller in zip(frames, resized, strict=True):
        smaller[:] = Image.fromarray(frame).resize((width, height), Image.Resampling.BICUBIC)
    return resized
