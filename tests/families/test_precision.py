# SPDX-License-Identifier: MIT
"""float32 products use no lower precision."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

import goldens
from rfm import families
from rfm.engine import Engine
from rfm.engine.layers import MKL_FUNCTIONS


def test_the_first_calls_of_all_functions_of_mkl_are_made_by_one_thread() -> None:
    """A wrong first call is rare, so this compares the list with PyTorch's header."""
    header = Path(torch.__file__).parent / "include" / "ATen" / "cpu" / "vml.h"
    named = re.findall(r"^ *IMPLEMENT_VML_MKL\((\w+),", header.read_text(), re.MULTILINE)
    assert sorted(named) == sorted(function.__name__ for function in MKL_FUNCTIONS)
    assert "cos" in named


def test_an_engine_multiplies_float32_as_float32(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", True)
    monkeypatch.setattr(torch.backends.cuda.matmul, "allow_tf32", True)
    Engine.of(families.load(goldens.REWIND[0].checkpoint))
    assert not torch.backends.cudnn.allow_tf32
    assert not torch.backends.cuda.matmul.allow_tf32
