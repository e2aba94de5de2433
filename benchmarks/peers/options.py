# SPDX-License-Identifier: MIT
"""The command-line options of both peers."""

from __future__ import annotations

import argparse


def options(told: str | None) -> argparse.Namespace:
    """Parse a peer's command-line options."""
    parser = argparse.ArgumentParser(description=told, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", required=True, help="checkpoint folder")
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    return parser.parse_args()
