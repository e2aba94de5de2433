# SPDX-License-Identifier: MIT
"""``make parity``: score every reference case with Triton, and compare with upstream's scores."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.table import Table

import goldens
import rfm_export
from engines import serve_config
from rfm.serve.installation import find_installation
from rfm.serve.triton_server import Endpoints, TritonServer
from rfm_client import RewardClient


def main() -> int:
    """Print the differences. Returns 1 if a case is outside its tolerance."""
    table = Table(title="largest difference from the original", title_justify="left")
    for column in ("case", "raw scores", "probabilities", "allowed"):
        table.add_column(column)
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        repository = Path(folder) / "model_repository"
        for config in (*goldens.REWIND, *goldens.WITH_ENCODERS, *goldens.VLM):
            rfm_export.export(config.checkpoint, repository, serve_config(config, config.name))
        log = (Path(folder) / "log").open("wb")
        with log, TritonServer(repository, Endpoints.free(), find_installation(), log=log) as server:
            for case in goldens.ANSWERED:
                with RewardClient(server.endpoints.grpc_url, model=case.config.name) as client:
                    results = client.evaluate(case.samples(), logits=case.config.is_discrete)
                each = [goldens.differences(r, e) for r, e in zip(results, case.expected(), strict=True)]
                raw, probability = (max(values) for values in zip(*each, strict=True))
                allowed = case.tolerances
                failed += raw > allowed[0] or probability > allowed[1]
                table.add_row(str(case), f"{raw:.1e}", f"{probability:.1e}", f"{allowed[0]:g}, {allowed[1]:g}")
    Console(width=110).print(table)
    print(f"{len(goldens.ANSWERED)} cases, {failed} outside what is allowed")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
