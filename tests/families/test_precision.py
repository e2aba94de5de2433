# SPDX-License-Identifier: MIT
"""What is computed as float32 is float32."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import torch

import goldens
from rfm.engine.layers import MKL_FUNCTIONS, keep_float32

ENGINE_IS_MADE = """
import sys
from rfm.engine import layers as precision
from rfm.engine import Engine
assert precision._call_each_once.cache_info().currsize == 0
Engine.from_checkpoint(sys.argv[1])
assert precision._call_each_once.cache_info().currsize == 1
"""


def test_the_first_calls_of_all_functions_of_mkl_are_made_by_one_thread() -> None:
    """A wrong first call comes once in hundreds of processes, so this looks at the list, which PyTorch's header gives."""
    header = Path(torch.__file__).parent / "include" / "ATen" / "cpu" / "vml.h"
    named = re.findall(r"^ *IMPLEMENT_VML_MKL\((\w+),", header.read_text(), re.MULTILINE)
    assert sorted(named) == sorted(function.__name__ for function in MKL_FUNCTIONS)
    assert "cos" in named


def test_an_engine_makes_them_before_anything_is_scored() -> None:
    checkpoint = str(goldens.REWIND[0].checkpoint)
    subprocess.run([sys.executable, "-c", ENGINE_IS_MADE, checkpoint], check=True)


def test_a_gpu_multiplies_float32_as_float32() -> None:
    keep_float32()
    assert not torch.backends.cudnn.allow_tf32
    assert not torch.backends.cuda.matmul.allow_tf32
