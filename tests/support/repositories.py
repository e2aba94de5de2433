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


def configure(model: Path, *, instances: int = 1, batch_size: int = 64, **parameters: int) -> None:
    """Changes an exported model's configuration: the number of ``instances``, and parameters."""
    file = model / CONFIG_FILE
    config = parse(file.read_text())
    config.instance_group[0].count, config.max_batch_size = instances, batch_size
    for name, value in parameters.items():
        assert name in config.parameters
        config.parameters[name].string_value = str(value)
    file.write_text(render(config))


def bound_queue(model: Path, *, max_queue_size: int = 0, timeout_ms: int = 0) -> None:
    """Changes an exported model's configuration: so many requests may wait in Triton, and so long; 0: any."""
    file = model / CONFIG_FILE
    config = parse(file.read_text())
    policy = config.dynamic_batching.default_queue_policy
    policy.max_queue_size, policy.default_timeout_microseconds = max_queue_size, 1000 * timeout_ms
    policy.allow_timeout_override = True
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
