# SPDX-License-Identifier: MIT
"""The ``rfm-client`` command: scores, comparisons and server status on the command line."""

from __future__ import annotations

import os
import sys


def main() -> None:
    """Entry point of the ``rfm-client`` console script."""
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")  # gRPC's own lines say less than the error, and hide it
    try:
        from rfm_client.cli.commands import app
    except ModuleNotFoundError as error:
        sys.exit(f'rfm-client: expected the package {error.name}, got none: pip install "./client[cli]"')
    app()
