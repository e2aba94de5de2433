# SPDX-License-Identifier: MIT
"""A simulated accelerator: an engine whose forward passes are a sleep, so that what a server does beside them shows.

The sleep takes no CPU and no lock, as a GPU's forward pass does. How long all of them took, and how many samples they
were of, stands in a file that others read.
"""

from __future__ import annotations

import fcntl
import json
import mmap
import struct
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rfm.engine import Engine
from rfm.engine.predictor import RowScores
from rfm_client import FrameScores

SIMULATION = "simulated.json"
_LEDGER = struct.Struct("<dQ")  # seconds in forward passes, rows in them


class Ledger:
    """What a simulated accelerator has done, in ``file``."""

    def __init__(self, file: Path) -> None:
        if not file.exists():
            file.write_bytes(_LEDGER.pack(0.0, 0))
        self._file = file.open("r+b")
        self._memory = mmap.mmap(self._file.fileno(), 0)

    def read(self) -> tuple[float, int]:
        """Seconds in forward passes, and rows in them, since the beginning."""
        busy_s, num_rows = _LEDGER.unpack_from(self._memory)
        return float(busy_s), int(num_rows)

    def run(self, duration_s: float, num_rows: int) -> None:
        """Sleeps, as one forward pass; several instances take turns."""
        fcntl.flock(self._file, fcntl.LOCK_EX)
        started_s = time.perf_counter()
        time.sleep(duration_s)
        before = self.read()
        _LEDGER.pack_into(self._memory, 0, before[0] + time.perf_counter() - started_s, before[1] + num_rows)
        fcntl.flock(self._file, fcntl.LOCK_UN)


def simulate(engine: Engine, file: Path, batch_s: float, row_s: float) -> Engine:
    """The engine, whose forward passes only sleep: ``batch_s`` and ``row_s`` for each row. Scores are 0.5."""
    ledger, num_bins = Ledger(file), engine.predictor.network.config.progress_bins

    def score(rows: Sequence[Any], batch: Any) -> list[RowScores]:
        ledger.run(batch_s + row_s * len(rows), len(rows))
        return [_half(row, num_bins) for row in rows]

    engine.predictor.score = score  # type: ignore[method-assign]  # only the forward pass is replaced
    return engine


def _half(row: Any, num_bins: int) -> RowScores:
    """Scores of a row of either family."""
    counts = [film.num_shown for film in row.films] if hasattr(row, "films") else [len(video) for video in row.videos]
    frames = []
    for count in counts:
        half = np.full(count, 0.5, np.float32)
        logits = np.zeros((count, num_bins), np.float32) if num_bins > 1 else None
        frames.append(FrameScores(progress=half, success=half, progress_logits=logits))
    return RowScores(frames, 0.5 if len(counts) > 1 else None)


def engine_of(checkpoint: str, device: str = "cpu") -> Engine:
    """The engine of a checkpoint; simulated if SIMULATION lies in its folder, with the arguments of ``simulate``."""
    engine = Engine.from_checkpoint(checkpoint, device=device)
    simulation = Path(checkpoint, SIMULATION)
    if not simulation.exists():
        return engine
    file, *times_s = json.loads(simulation.read_text())
    return simulate(engine, Path(file), *times_s)
