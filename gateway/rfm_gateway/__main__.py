# SPDX-License-Identifier: MIT
"""``python -m rfm_gateway``, for whoever has neither command."""

from __future__ import annotations

import typer

from rfm_gateway.command import gateway

if __name__ == "__main__":
    typer.run(gateway)
