# SPDX-License-Identifier: MIT
"""What tests do to a model repository and its processes."""

from __future__ import annotations

import os
import signal
from contextlib import suppress
from pathlib import Path

from rfm_export.layout import CONFIG_FILE
from rfm_export.pbtxt import parse, render


def forget_input(repository: Path, model: str, name: str) -> None:
    """The model's configuration becomes one from before it had this input."""
    file = repository / model / CONFIG_FILE
    config = parse(file.read_text())
    inputs = [tensor for tensor in config.input if tensor.name != name]
    assert len(inputs) < len(config.input)
    del config.input[:]
    config.input.extend(inputs)
    for step in config.ensemble_scheduling.step:
        step.input_map.pop(name, None)
    file.write_text(render(config))


def kill_model(repository: Path, model: str = "rfm") -> None:
    """Kills each process of a model that a server of ``repository`` runs."""
    model_file = f"{repository}/{model}/1/model.py"
    killed = []
    for command in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):  # it has ended meanwhile
            if model_file in command.read_text():
                killed.append(command)
                os.kill(int(command.parent.name), signal.SIGKILL)
    assert killed
