# SPDX-License-Identifier: MIT
"""A control for the fault suite: the same Triton, configuration and requests, but none of our code behind them.

A bound that the control breaks too is a limit of Triton.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rfm.supervise.installation import find_installation
from rfm.supervise.process import Endpoints, TritonServer

MODEL = Path(__file__).parent / "control_model.py"
SERVICE_PARAMETER = "control_service_s"  # control_model.py reads it
SCORE = 0.5  # what control_model.py answers


def control_repository(repository: Path, folder: Path, service_s: float) -> Path:
    """A copy of ``repository`` with every model.py replaced by control_model.py, without checkpoints.

    service_s: seconds of one core that a request costs
    """
    without = shutil.ignore_patterns("checkpoint", "image_encoder", "text_encoder", "__pycache__")
    shutil.copytree(repository, folder, ignore=without)
    for model in folder.glob("*/*/model.py"):
        shutil.copyfile(MODEL, model)
        with (model.parents[1] / "config.pbtxt").open("a") as config:
            value = f'value {{ string_value: "{service_s:.6f}" }}'
            config.write(f'parameters {{ key: "{SERVICE_PARAMETER}" {value} }}\n')
    return folder


@contextmanager
def control(repository: Path, folder: Path, service_s: float = 0.0) -> Iterator[Endpoints]:
    """A Triton that serves the control of ``repository`` from ``folder``, which this makes."""
    copied = control_repository(repository, folder / "model_repository", service_s)
    with (
        (folder / "tritonserver.log").open("wb") as log,
        TritonServer(copied, Endpoints.free(), find_installation(), log=log) as server,
    ):
        yield server.endpoints
