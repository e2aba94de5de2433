# SPDX-License-Identifier: MIT
"""float32 on a GPU means float32."""

from __future__ import annotations

import torch


def keep_float32() -> None:
    """Has GPUs multiply float32 as float32.

    PyTorch has cuDNN round what a convolution reads to TF32, with 10 bits of 23, which moves scores by more than 1e-5.
    """
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False
