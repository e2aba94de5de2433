# SPDX-License-Identifier: MIT
"""Changes of a model repository and its processes, and models that break on demand."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tritonclient.grpc.model_config_pb2 import ModelConfig

from commands import REPOSITORY, running_models
from rfm_client.contract.description import Description
from rfm_export.layout import CONFIG_FILE, description_in
from rfm_export.pbtxt import parse, render
from servers import MODEL


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


def configure(model: Path, *, batch_size: int = 64, **parameters: int) -> None:
    """Change the batch size and parameters in an exported model's configuration."""
    with changing(model) as config:
        config.max_batch_size = batch_size
        for name, value in parameters.items():
            assert name in config.parameters
            config.parameters[name].string_value = str(value)


def bound_queue(model: Path, max_queue_size: int) -> None:
    """Bound the number of requests in an exported model's queue."""
    with changing(model) as config:
        policy = config.dynamic_batching.default_queue_policy
        policy.max_queue_size, policy.allow_timeout_override = max_queue_size, True


def kill_model(repository: Path, model: str = "rfm") -> None:
    """Kill all processes of a model in ``repository``."""
    killed = running_models(repository, model)
    assert killed
    for pid in killed:
        with suppress(ProcessLookupError):  # it has ended meanwhile
            os.kill(pid, signal.SIGKILL)


def answering(body: str) -> str:
    """Return code for a model.py that runs ``body`` before it answers."""
    return f"""

_plain_answer = TritonPythonModel.answer


def answer(self, questions, execution):
    import os, time

    {body}
    return _plain_answer(self, questions, execution)


TritonPythonModel.answer = answer
"""


FAILING_STEPS = 7  # of the samples on which a model fails
FAILING = answering(f"""if any(getattr(question.sample, "frame_steps", 0) == {FAILING_STEPS} for question in questions):
        raise ZeroDivisionError("a fault of the model's")""")


def make_repository(folder: Path, more_code: str = "") -> Path:
    """The demo's ``rfm`` on one thread, with more code in its model.py."""
    repository = folder / "model_repository"
    shutil.copytree(REPOSITORY / MODEL, repository / MODEL)
    model = repository / MODEL / "1" / "model.py"
    model.write_text(model.read_text() + more_code)
    configure(repository / MODEL, torch_threads=1)
    return repository
