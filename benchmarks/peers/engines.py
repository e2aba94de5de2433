# SPDX-License-Identifier: MIT
"""Messages and engine of the LitServe and mosec servers.

T frames, D width of a frame embedding, Dt width of a text embedding.

A message is a msgpack map for a sample, with arrays as float32 bytes. Request: ``type`` (progress, preference or
similarity), ``shapes`` ([T, D] of each trajectory), ``video`` (their embeddings in sequence) and ``text`` (the first
trajectory's [Dt]). Answer: ``progress`` and ``success`` (float32 [T] of each trajectory), and for pairs ``query``; or
``error``. With a simulated accelerator, forward passes sleep, without CPU time and without the GIL.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import mmap
import struct
import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from rfm import families
from rfm.engine import Engine, Outcome
from rfm.engine.predictor import RowScores
from rfm_client import (
    FrameScores,
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    RewardError,
    Sample,
    SimilaritySample,
    Trajectory,
)

SIMULATION = "simulated.json"
_LEDGER = struct.Struct("<d")  # seconds in forward passes
_PAIRS = {"preference": PreferenceSample, "similarity": SimilaritySample}


def options(told: str | None) -> argparse.Namespace:
    """Return the options of a peer's command line."""
    parser = argparse.ArgumentParser(description=told, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", required=True, help="checkpoint folder")
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    return parser.parse_args()


def sample_of(message: Mapping[str, Any]) -> Sample:
    """Return the sample of a request. Raises KeyError, ValueError, InvalidSampleError."""
    text = np.frombuffer(message["text"], np.float32)
    video = np.frombuffer(message["video"], np.float32)
    shapes = message["shapes"]
    ends = np.cumsum([0, *(num_frames * width for num_frames, width in shapes)])
    parts = [video[start:end].reshape(shape) for (start, end), shape in zip(pairwise(ends), shapes, strict=True)]
    trajectories = [Trajectory(video_embeddings=part, text_embedding=text) for part in parts]
    if message["type"] == "progress":
        return ProgressSample(*trajectories)
    return _PAIRS[message["type"]](*trajectories)


def answer_of(outcome: Outcome) -> dict[str, Any]:
    """Return the answer to a request."""
    if isinstance(outcome, RewardError):
        return {"error": str(outcome)}
    if isinstance(outcome, ProgressResult):
        return _frames(outcome)
    if isinstance(outcome, PreferenceResult):
        return {**_frames(outcome.first, outcome.second), "query": outcome.preference}
    return {**_frames(outcome.reference, outcome.other), "query": outcome.similarity}


def _frames(*scores: FrameScores) -> dict[str, Any]:
    return {
        "progress": [each.progress.tobytes() for each in scores],
        "success": [each.success.tobytes() for each in scores],
    }


class Ledger:
    """The working time of a simulated accelerator, kept in ``file`` for all processes."""

    def __init__(self, file: Path) -> None:
        if not file.exists():
            file.write_bytes(_LEDGER.pack(0.0))
        self._file = file.open("r+b")
        self._memory = mmap.mmap(self._file.fileno(), 0)

    def busy_s(self) -> float:
        """Return the seconds of all forward passes so far."""
        return float(_LEDGER.unpack_from(self._memory)[0])

    def run(self, duration_s: float) -> None:
        """Sleep for the time of a forward pass. Several instances take turns."""
        fcntl.flock(self._file, fcntl.LOCK_EX)
        started_s = time.perf_counter()
        time.sleep(duration_s)
        _LEDGER.pack_into(self._memory, 0, self.busy_s() + time.perf_counter() - started_s)
        fcntl.flock(self._file, fcntl.LOCK_UN)


def simulate(engine: Engine, file: Path, batch_s: float, row_s: float, least_s: float = 0.0) -> Engine:
    """Make the engine's forward passes sleep for ``batch_s``, plus ``row_s`` for each row. Scores are 0.5.

    least_s: shortest time of a forward pass, as the launch of kernels takes
    """
    ledger, num_bins = Ledger(file), engine.predictor.network.config.progress_bins

    def score(rows: Sequence[Any], batch: Any, execution: Any) -> list[RowScores]:
        ledger.run(max(batch_s + row_s * len(rows), least_s))
        return [_half(row, num_bins) for row in rows]

    engine.predictor.score = score  # type: ignore[method-assign]  # only the forward pass is replaced
    return engine


def _half(row: Any, num_bins: int) -> RowScores:
    """Return scores of 0.5 for a row of any family."""
    counts = [getattr(video, "num_shown", None) or len(video) for video in row.videos]
    frames = []
    for count in counts:
        half = np.full(count, 0.5, np.float32)
        logits = np.zeros((count, num_bins), np.float32) if num_bins > 1 else None
        frames.append(FrameScores(progress=half, success=half, progress_logits=logits))
    return RowScores(frames, 0.5 if len(counts) > 1 else None)


def engine_of(checkpoint: str, device: str = "cpu") -> Engine:
    """Return the engine of a checkpoint. A file SIMULATION in the folder has arguments for ``simulate``."""
    engine = Engine.of(families.load(checkpoint), device=device)
    simulation = Path(checkpoint, SIMULATION)
    if not simulation.exists():
        return engine
    file, *times_s = json.loads(simulation.read_text())
    return simulate(engine, Path(file), *times_s)
