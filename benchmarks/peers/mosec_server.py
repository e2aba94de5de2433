# SPDX-License-Identifier: MIT
"""Our engine behind mosec, with its dynamic batching: a Rust HTTP process and an inference process.

Requests and answers are msgpack (``engines``). The answer to an invalid sample has ``error``. In mosec, an unreadable
request fails its whole batch.
"""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import mosec
import torch
from mosec.mixin import MsgpackMixin

from engines import answer_of, engine_of, options, sample_of

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
        self.engine = engine_of(os.environ["PEER_CHECKPOINT"])

    def forward(self, data: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Return the answer to each request in a batch."""
        return [answer_of(outcome) for outcome in self.engine.evaluate([sample_of(message) for message in data])]


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
