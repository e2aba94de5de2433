# SPDX-License-Identifier: MIT
"""Our engine behind mosec, with its dynamic batching: a Rust HTTP process and an inference process.

A request is a msgpack map for one progress sample, with arrays as float32 bytes: ``shape``, [T, D], ``video`` and
``text``. Its answer has ``progress``, float32 [T], or ``error``. In mosec, an unreadable request fails its whole batch.
"""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import mosec
import numpy as np
import torch
from mosec.mixin import MsgpackMixin
from options import options

from rfm import published
from rfm.engine import Engine
from rfm_client import ProgressResult, ProgressSample, Trajectory

MAX_BATCH_SIZE = 64
MAX_WAIT_MS = 1  # mosec's minimum
REQUEST_TIMEOUT_MS = 60_000


class RewardWorker(MsgpackMixin, mosec.Worker):
    """Scores samples in the inference process. Environment variables name the checkpoint."""

    def __init__(self) -> None:
        super().__init__()
        warnings.filterwarnings("ignore", "IPC data", RuntimeWarning)  # one warning for each large batch
        torch.set_num_threads(int(os.environ["PEER_THREADS"]))
        torch.set_num_interop_threads(1)
        self.engine = Engine.of(published.load(os.environ["PEER_CHECKPOINT"]))

    def forward(self, data: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Return the answer to each request in a batch."""
        samples = []
        for message in data:
            video = np.frombuffer(message["video"], np.float32).reshape(message["shape"])
            text = np.frombuffer(message["text"], np.float32)
            samples.append(ProgressSample(Trajectory(video_embeddings=video, text_embedding=text)))
        outcomes = self.engine.evaluate(samples)
        return [
            {"progress": outcome.progress.tobytes()} if isinstance(outcome, ProgressResult) else {"error": str(outcome)}
            for outcome in outcomes
        ]


def main() -> None:
    """Serve until SIGTERM."""
    arguments = options(__doc__)
    os.environ |= {  # mosec reads its own settings from here
        "MOSEC_ADDRESS": "127.0.0.1",
        "MOSEC_PORT": str(arguments.port),
        "MOSEC_LOG_LEVEL": "error",
        "MOSEC_TIMEOUT": str(REQUEST_TIMEOUT_MS),
    }
    logging.getLogger(mosec.log.MOSEC_LOG_NAME).setLevel(logging.ERROR)  # mosec set its level on import
    server = mosec.Server()
    settings = {"PEER_CHECKPOINT": arguments.checkpoint, "PEER_THREADS": str(arguments.threads)}
    server.append_worker(
        RewardWorker,
        max_batch_size=MAX_BATCH_SIZE,
        max_wait_time=MAX_WAIT_MS,
        env=[settings],
    )
    server.run()


if __name__ == "__main__":
    main()
