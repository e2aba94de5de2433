# SPDX-License-Identifier: MIT
"""Certificates, and servers with TLS and keys."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import goldens
from commands import EXIT_S, REPOSITORY, command, regions
from engines import load_engine
from rfm.launch.cleanup import REGION_PREFIX
from rfm.launch.process import Endpoints, TritonServer
from rfm_client import AccessDeniedError, ProgressSample, RewardClient
from trajectories import random_trajectory

PLAIN = goldens.config("c1_t1_disc10")


TRAJECTORY = random_trajectory(0, 5)


TOLERANCE = 1e-5


KEY = "a-key-that-only-tests-know"


GATED = "inference,health,metadata,model-config,statistics"


PUBLIC_HOST = "127.0.0.2"  # stands for an address that others reach


AT_ONCE_S = 20.0  # far less than the client would retry


@dataclass(frozen=True)
class Papers:
    """Certificates (PEM): of an authority, of a server and a client that it vouches for, and of a stranger's."""

    ca: Path
    certificate: Path
    key: Path
    client_certificate: Path
    client_key: Path
    other_ca: Path

    @property
    def client(self) -> dict[str, Path]:
        """Options of a client that has everything."""
        return {"ca_file": self.ca, "client_certificate": self.client_certificate, "client_key": self.client_key}


def regions_of(process_id: int) -> set[str]:
    """Shared memory of the servers that a process has started."""
    return {name for name in regions() if name.startswith(f"{REGION_PREFIX}_{process_id}_")}


@contextmanager
def nothing_left_behind() -> Iterator[None]:
    before = regions_of(os.getpid())
    yield
    assert regions_of(os.getpid()) <= before


class GatedServer(TritonServer):
    """Asks for a key over gRPC, as a proxy before it may."""

    def _arguments(self, models: Any) -> list[str]:
        return [*super()._arguments(models), f"--grpc-restricted-protocol={GATED}:gate={KEY}"]


def client(url: str, **options: Any) -> RewardClient:
    return RewardClient(url, **options)


def scores_right(client: RewardClient) -> None:
    expected = load_engine(PLAIN.name).evaluate([ProgressSample(TRAJECTORY)])[0]
    got = client.progress(TRAJECTORY)
    np.testing.assert_allclose(got.progress, expected.progress, atol=TOLERANCE)  # type: ignore[union-attr]


@contextmanager
def denied_at_once(match: str) -> Iterator[None]:
    started_s = time.monotonic()
    with pytest.raises(AccessDeniedError, match=match):
        yield
    assert time.monotonic() - started_s < AT_ONCE_S


def refused_to_serve(*words: object) -> str:
    done = subprocess.run(
        [*command(REPOSITORY, Endpoints.free()), *map(str, words)],
        capture_output=True,
        text=True,
        timeout=EXIT_S,
        check=False,
    )
    assert done.returncode == 1, done.stderr
    return done.stderr
