# SPDX-License-Identifier: MIT
"""The ``rfm`` commands. They join packages that do not import each other."""

from __future__ import annotations

import os


def main() -> None:
    """Entry point of the ``rfm`` console script."""
    is_ours = "GRPC_VERBOSITY" not in os.environ  # gRPC reads it when it is imported
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")
    from rfm_commands import cli

    if is_ours:
        del os.environ["GRPC_VERBOSITY"]  # Triton and the gateway keep their lines
    cli.main()
