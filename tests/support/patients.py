# SPDX-License-Identifier: MIT
"""A small repository with a model that breaks on demand, and callers that notice."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from callers import Callers, Exam, progress_of
from paths import ROOT
from repositories import configure
from rfm import published
from rfm.engine import Engine
from rfm_client import ProgressSample, RewardClient
from servers import MODEL
from trajectories import random_trajectory

CALLERS = 16
PAUSE_S = 0.05  # without it they would take the processors from a server that starts


def answering(body: str) -> str:
    """Return code for a model.py that runs ``body`` before it answers."""
    return f"""

_plain_answer = TritonPythonModel.answer


def answer(self, questions, execution):
    import os, pathlib, time

    {body}
    return _plain_answer(self, questions, execution)


TritonPythonModel.answer = answer
"""


def answering_after(seconds: float, began: Path | None = None) -> str:
    """Return code for a model.py with slower answers. began: a file that each answer creates first"""
    note = "" if began is None else f"pathlib.Path({str(began)!r}).touch(); "
    return answering(f"{note}time.sleep({seconds})")


def make_repository(
    folder: Path, *, more_code: str = "", instances: int = 1, batch_size: int = 64, **settings: int
) -> Path:
    """The demo's ``rfm`` on one thread, changed as a test needs it; ``settings``: such as ``max_queue_size``."""
    repository = folder / "model_repository"
    shutil.copytree(ROOT / "model_repository" / MODEL, repository / MODEL, ignore=shutil.ignore_patterns("__pycache__"))
    model = repository / MODEL / "1" / "model.py"
    model.write_text(model.read_text() + more_code)
    configure(repository / MODEL, instances=instances, batch_size=batch_size, torch_threads=1, **settings)
    return repository


SAMPLES = [ProgressSample(random_trajectory(number, 8, 64, 32)) for number in range(CALLERS)]


@pytest.fixture(scope="module")
def references() -> list[np.ndarray[Any, Any]]:
    """The engine's answers, without Triton."""
    engine = Engine.of(published.load(ROOT / "model_repository" / MODEL / "1" / "checkpoint"))
    return [result.progress for result in engine.evaluate(SAMPLES)]  # type: ignore[union-attr]


def calling(client: RewardClient, references: list[np.ndarray[Any, Any]]) -> Callers:
    """Return 16 threads that ask again and again and compare each answer with the engine's."""
    return Callers(progress_of(client), Exam(SAMPLES, references), CALLERS, PAUSE_S)
