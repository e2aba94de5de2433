# SPDX-License-Identifier: MIT
"""A control for the fault suite: the same Triton, configuration and requests, but none of our code behind them.

A bound that the control breaks too is a limit of Triton.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rfm.launch.installation import find_installation
from rfm.launch.process import Endpoints, TritonServer

MODEL = Path(__file__).parent / "control_model.py"


def control_repository(repository: Path, folder: Path) -> Path:
    """A copy of ``repository`` with every model.py replaced by control_model.py, without checkpoints."""
    without = shutil.ignore_patterns("checkpoint", "image_encoder", "text_encoder", "__pycache__")
    shutil.copytree(repository, folder, ignore=without)
    for model in folder.glob("*/*/model.py"):
        shutil.copyfile(MODEL, model)
    return folder


@contextmanager
def control(repository: Path, folder: Path) -> Iterator[Endpoints]:
    """A Triton that serves the control of ``repository`` from ``folder``, which this makes."""
    copied = control_repository(repository, folder / "model_repository")
    with (
        (folder / "tritonserver.log").open("wb") as log,
        TritonServer(copied, Endpoints.free(), find_installation(), log=log) as server,
    ):
        yield server.endpoints
