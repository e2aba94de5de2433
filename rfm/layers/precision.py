# SPDX-License-Identifier: MIT
"""float32 means float32, on a GPU and on a CPU."""

from __future__ import annotations

from functools import cache

import torch

# What PyTorch has MKL compute on a CPU: IMPLEMENT_VML_MKL in its ATen/cpu/vml.h.
MKL_FUNCTIONS = (
    torch.acos,
    torch.asin,
    torch.atan,
    torch.cos,
    torch.erf,
    torch.erfc,
    torch.erfinv,
    torch.exp,
    torch.log,
    torch.log10,
    torch.log2,
    torch.sin,
    torch.sqrt,
    torch.tan,
    torch.tanh,
    torch.trunc,
)


def keep_float32() -> None:
    """Has GPUs and CPUs compute float32 as float32. To be called before they compute anything.

    GPU: PyTorch has cuDNN round what a convolution reads to TF32, with 10 bits of 23, which moves scores by more than
    1e-5.
    CPU: MKL 2024.2 chooses the code of a function at its first call. If several threads make that call together, one of
    them may compute its part with less exact code, and a cosine is 1.5e-4 off (pytorch/pytorch#188792). So one thread
    makes the first calls here.
    """
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False
    _call_each_once()


@cache
def _call_each_once() -> None:
    for dtype in (torch.float32, torch.float64):
        for function in MKL_FUNCTIONS:
            function(torch.zeros(1, dtype=dtype))
