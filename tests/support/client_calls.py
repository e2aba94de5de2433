# SPDX-License-Identifier: MIT
"""Calls of both clients."""

from __future__ import annotations

from concurrent.futures import Future

from mixtures import MODEL
from rfm_client import (
    Result,
    RewardClient,
    Sample,
)

NOBODY = "grpc://127.0.0.1:1"  # a port where nothing listens


def futures(url: str, samples: list[Sample]) -> list[Result]:
    with RewardClient(url, model=MODEL) as client:
        submitted: list[Future[Result]] = [client.submit(sample) for sample in samples]
        return [future.result() for future in submitted]
