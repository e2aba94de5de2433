# SPDX-License-Identifier: MIT
"""``python -m rfm_gateway``: the gateway as ``rfm serve`` runs it beside Triton."""

from __future__ import annotations

import typer

from rfm_client.command_line import Command
from rfm_gateway.command import gateway

if __name__ == "__main__":
    app = typer.Typer(add_completion=False, rich_markup_mode=None)  # Rich's tables cut off option names
    app.command(cls=Command)(gateway)
    app()
