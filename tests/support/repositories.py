# SPDX-License-Identifier: MIT
"""Changes of a model repository and its processes."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tritonclient.grpc.model_config_pb2 import ModelConfig

from commands import running
from rfm_client.contract.description import Description
from rfm_export.layout import CONFIG_FILE, description_in
from rfm_export.pbtxt import parse, render


@contextmanager
def changing(model: Path) -> Iterator[ModelConfig]:
    """Change an exported model's configuration in place."""
    file = model / CONFIG_FILE
    config = parse(file.read_text())
    yield config
    file.write_text(render(config))


def description_of(model: Path) -> Description:
    """The description in an exported model's configuration."""
    return description_in(parse((model / CONFIG_FILE).read_text()))


def forget_input(repository: Path, model: str, name: str) -> None:
    """The model's configuration becomes one from before it had this input."""
    with changing(repository / model) as config:
        inputs = [tensor for tensor in config.input if tensor.name != name]
        assert len(inputs) < len(config.input)
        del config.input[:]
        config.input.extend(inputs)
        for step in config.ensemble_scheduling.step:
            step.input_map.pop(name, None)


def configure(model: Path, *, instances: int = 1, batch_size: int = 64, **parameters: int) -> None:
    """Changes an exported model's configuration: the number of ``instances``, and parameters."""
    with changing(model) as config:
        config.instance_group[0].count, config.max_batch_size = instances, batch_size
        for name, value in parameters.items():
            assert name in config.parameters
            config.parameters[name].string_value = str(value)


def bound_queue(model: Path, *, max_queue_size: int = 0, timeout_ms: int = 0) -> None:
    """Bound the queue of an exported model in number and time of requests; 0: unbounded."""
    with changing(model) as config:
        policy = config.dynamic_batching.default_queue_policy
        policy.max_queue_size, policy.default_timeout_microseconds = max_queue_size, 1000 * timeout_ms
        policy.allow_timeout_override = True


def kill_model(repository: Path, model: str = "rfm") -> None:
    """Kill all processes of a model in ``repository``."""
    model_file = f"{repository}/{model}/1/model.py"
    killed = running(model_file)
    assert killed
    for pid in killed:
        with suppress(ProcessLookupError):  # it has ended meanwhile
            os.kill(pid, signal.SIGKILL)
