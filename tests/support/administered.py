# SPDX-License-Identifier: MIT
"""A server with an admin key, and the rfm models command."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import goldens
import rfm_export
from engines import serve_config
from rfm.launch.process import Endpoints
from rfm_client import RewardClient
from rfm_export.publish import read_config
from rollout import models

KEY = "a-key-that-only-tests-know"


PLAIN = goldens.config("c1_t1_disc10")  # embeddings alone


@dataclass(frozen=True)
class Running:
    """A server with the reference checkpoint with encoders as ``rfm``, which asks for KEY."""

    repository: Path
    endpoints: Endpoints
    key_file: Path
    log: Path

    def models(self, command: str, *words: str) -> str:
        """Output of ``rfm models COMMAND``, which succeeds."""
        done = models(command, self.repository, self.endpoints.grpc_url, self.key_file, *words)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def refused(self, command: str, *words: str) -> str:
        """What it says where it fails."""
        done = models(command, self.repository, self.endpoints.grpc_url, self.key_file, *words)
        assert done.returncode == 1, done.stdout
        (line,) = done.stderr.splitlines()
        return line

    def served_by_restart(self, model: str) -> list[int]:
        return list(read_config(self.repository, model).version_policy.specific.versions)

    def client(self, model: str) -> RewardClient:
        return RewardClient(self.endpoints.grpc_url, model=model, retry=False)


def export_plain(repository: Path, name: str, checkpoint: Path = PLAIN.checkpoint) -> int:
    return rfm_export.export(checkpoint, repository, serve_config(PLAIN, name))
