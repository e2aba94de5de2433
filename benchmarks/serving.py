# SPDX-License-Identifier: MIT
"""Export and serve a checkpoint for a benchmark, with packages from the Python or checkout that runs this file.

    serving.py CHECKPOINT FOLDER SETTINGS

SETTINGS is the ``export`` section as JSON. Prints the server's addresses as a JSON line as soon as it is ready, and
serves until standard input ends. Imports only what older commits also have.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import rfm_export
from rfm.config import ExportConfig
from rfm.serve.triton_server import temporary_server


def main(checkpoint: str, folder: Path, settings: str) -> None:
    """Serve until standard input ends."""
    rfm_export.export(checkpoint, folder / "repository", ExportConfig(**json.loads(settings)))
    with temporary_server(folder / "repository", folder / "triton.log") as ends:
        print(json.dumps({"grpc": ends.grpc_url, "metrics": ends.metrics_url}), flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3])
