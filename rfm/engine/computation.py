# SPDX-License-Identifier: MIT
"""Name the number type, PyTorch version and attention, which decide a score's last digits.

PyTorch chooses the kernel for ``scaled_dot_product_attention`` by its version, the GPU, the dtype and the shapes.
"""

from __future__ import annotations

from typing import Any

import torch

TORCH = f"torch {torch.__version__}"
ATTENTION = "scaled_dot_product_attention"


def computation(checkpoint: Any, dtype: torch.dtype | None, *, on_gpu: bool) -> str:
    """Return number type, PyTorch version and attention as one line.

    dtype: network dtype; None: float32 on the CPU, otherwise the checkpoint's own
    """
    if dtype is None:
        dtype = getattr(checkpoint.config, "torch_dtype", torch.float32) if on_gpu else torch.float32
    return f"{str(dtype).removeprefix('torch.')}, {TORCH}, {ATTENTION}"
