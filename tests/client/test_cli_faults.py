# SPDX-License-Identifier: MIT
"""rfm-client and servers that go away while it asks."""

from __future__ import annotations

import json
import re
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

from client_commands import RFM_CLIENT
from one_model import OneModelServer
from rfm.launch.process import Endpoints
from rfm_client.cli.options import ExitCode
from rfm_client.cli.scoring import WORKERS

pytestmark = pytest.mark.triton

NUM_SOURCES = 2000  # more than are scored before the server is gone
NOT_ASKED = "not asked, since no server answers any more"


ENDS = {"killed": (signal.SIGKILL, ExitCode.UNAVAILABLE), "hangs": (signal.SIGSTOP, ExitCode.DEADLINE)}


@pytest.mark.parametrize(("number", "code"), ENDS.values(), ids=ENDS)
def test_a_server_that_goes_away_is_not_asked_any_more(
    repository: Path, tmp_path: Path, number: signal.Signals, code: ExitCode
) -> None:
    random = np.random.default_rng(0)
    source, target = tmp_path / "episode.npz", tmp_path / "scores.json"
    embeddings = {"video_embeddings": random.random((8, 64)), "text_embedding": random.random(32)}
    np.savez(source, **{name: array.astype(np.float32) for name, array in embeddings.items()})
    with OneModelServer(repository, Endpoints.free()) as server:
        command = [RFM_CLIENT, "score", *[source] * NUM_SOURCES, "--timeout", "3", "--json", target]
        process = subprocess.Popen(
            [*map(str, command), "--url", server.endpoints.grpc_url],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        first = [process.stdout.readline() for _ in range(10)]  # they come while others are asked
        server.signal(number)
        try:
            rest, told = process.communicate(timeout=60)
        finally:
            server.kill()
    assert process.returncode == code, told
    rows = [line for line in [*first, *rest.splitlines()] if line.strip().startswith(str(source))]
    outcomes = json.loads(target.read_text())["videos"]
    failures = [outcome for outcome in outcomes if "error" in outcome]
    assert len(outcomes) == NUM_SOURCES
    assert len(rows) == NUM_SOURCES - len(failures) >= 5
    not_asked = [failure for failure in failures if failure["error"] == NOT_ASKED]
    assert 0 < len(failures) - len(not_asked) <= WORKERS
    assert len(re.findall(f"^rfm-client: {source}: {NOT_ASKED}$", told, re.MULTILINE)) == len(not_asked) > 0
