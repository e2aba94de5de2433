# SPDX-License-Identifier: MIT
"""Servers that stop, hang and come back during calls."""

from __future__ import annotations

import numpy as np
import tritonclient.grpc

from commands import in_shared_memory
from rfm_client import Trajectory
from servers import Endpoints


def url_of(endpoints: Endpoints, protocol: str) -> str:
    return endpoints.grpc_url if protocol == "grpc" else endpoints.http_url


def trajectory(seed: int, num_frames: int = 8) -> Trajectory:
    random = np.random.default_rng(seed)
    return Trajectory(
        video_embeddings=random.standard_normal((num_frames, 64), np.float32),
        text_embedding=random.standard_normal(32, np.float32),
    )


def heavy() -> Trajectory:
    """Large enough for shared memory."""
    return trajectory(0, 2000)


def regions(endpoints: Endpoints) -> set[str]:
    """Return the names of the server's mapped regions."""
    with tritonclient.grpc.InferenceServerClient(endpoints.grpc_url.removeprefix("grpc://")) as client:
        return set(client.get_system_shared_memory_status().regions)


def ours_in_dev_shm() -> set[str]:
    return {name for name in in_shared_memory() if "rfm-client-" in name}
