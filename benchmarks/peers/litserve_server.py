# SPDX-License-Identifier: MIT
"""Our engine behind LitServe, with its dynamic batching: an HTTP process and an inference process.

Requests and answers are raw bytes (``engines``), so the server parses neither JSON nor a form. An invalid sample gets
status 400. In LitServe, an unreadable request fails its whole batch.
"""

# No "from __future__ import annotations": LitServe passes annotations to FastAPI unresolved.
import multiprocessing
import signal
from typing import Annotated, Any

import litserve
import msgpack
import torch
from fastapi import Body, Response

from engines import answer_of, engine_of, options, sample_of
from rfm.engine import Outcome
from rfm_client import Sample

MAX_BATCH_SIZE = 64
BATCH_TIMEOUT_S = 0.001  # 0 would spin on the queue of another process
REQUEST_TIMEOUT_S = 60
MIME_TYPE = "application/msgpack"


class RewardAPI(litserve.LitAPI):
    """LitServe's adapter: samples in, scores out."""

    def __init__(self, checkpoint: str, threads: int, **settings: Any) -> None:
        super().__init__(**settings)
        self.checkpoint = checkpoint
        self.threads = threads

    def setup(self, device: str) -> None:
        """Load the engine, in the inference process."""
        torch.set_num_threads(self.threads)
        torch.set_num_interop_threads(1)
        self.engine = engine_of(self.checkpoint, device)

    def decode_request(self, request: Annotated[bytes, Body(media_type=MIME_TYPE)]) -> Sample:
        """Return the sample in the body of a request."""
        return sample_of(msgpack.unpackb(request))

    def batch(self, inputs: list[Sample]) -> list[Sample]:
        """Return the samples unchanged, since the engine takes any mix."""
        return inputs

    def predict(self, x: list[Sample]) -> list[Outcome]:
        """Return the outcome of each sample."""
        return self.engine.evaluate(x)

    def unbatch(self, output: list[Outcome]) -> list[Outcome]:
        """Return the outcomes unchanged."""
        return output

    def encode_response(self, output: Outcome) -> Response:
        """Return the answer to a request."""
        answer = answer_of(output)
        return Response(msgpack.packb(answer), 400 if "error" in answer else 200, media_type=MIME_TYPE)


def main() -> None:
    """Serve until SIGTERM."""
    arguments = options(__doc__)
    batching = {"max_batch_size": MAX_BATCH_SIZE, "batch_timeout": BATCH_TIMEOUT_S}
    api = RewardAPI(arguments.checkpoint, arguments.threads, **batching)
    # Without fast_queue, which LitServe 0.2.19 ignores.
    server = litserve.LitServer(api, accelerator="cpu", timeout=REQUEST_TIMEOUT_S)
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        server.run(
            host="127.0.0.1",
            port=arguments.port,
            log_level="warning",
            access_log=False,
            generate_client_file=False,
        )
    finally:
        for process in multiprocessing.active_children():  # left over from an interrupted start
            process.terminate()


def _interrupt(*_: object) -> None:
    """End the server as SIGINT does, since LitServe ends its processes only then. They inherit this handler."""
    if multiprocessing.parent_process() is None:
        raise KeyboardInterrupt


if __name__ == "__main__":
    main()
