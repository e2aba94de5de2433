# SPDX-License-Identifier: MIT
"""The last lines of a command: what to try next, as commands to copy."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from rfm_client.cli.options import DEFAULT_URL
from rfm_client.contract.wire import DEFAULT_MODEL

DEFAULT_URLS = (DEFAULT_URL, DEFAULT_URL.replace("localhost", "127.0.0.1"))
PAGE_PORT = 8100
PAGE_URL = f"http://localhost:{PAGE_PORT}/"


def command(program: str, *words: object) -> str:
    """Return the command line to type: the program by name, or by path if its environment is not active."""
    beside = Path(sys.executable).with_name(program)
    if shutil.which(program) is None and beside.exists():
        program = os.path.relpath(beside) if beside.is_relative_to(Path.cwd()) else str(beside)
    return shlex.join([program, *map(str, words)])


def next_steps(*steps: tuple[str, str]) -> str:
    """Return lines for the user. steps: the purpose of each command, and the command"""
    return "\n".join(["Next:", *(f"  # {purpose}\n  {line}" for purpose, line in steps)])


def score_step(url: str, models: Sequence[str]) -> tuple[str, str]:
    """Return how to score something with a running server. models: those that score frames"""
    options = [] if url in DEFAULT_URLS else ["--url", url]
    if not models:
        return "score random embeddings", command("rfm-client", "sample", *options)
    options += [] if DEFAULT_MODEL in models else ["--model", models[0]]
    return "score a video", command("rfm-client", "score", "VIDEO", "--task", "TASK", *options)


def steps_with_server(url: str, models: Sequence[str]) -> str:
    """Return what to try with a running server. models: those that score frames"""
    steps = [score_step(url, models)]
    if models:
        options = [] if DEFAULT_MODEL in models else ["--model", models[0]]
        page = command("rfm-client", "gateway", "--port", PAGE_PORT, "--triton", url, *options)
        steps.append((f"serve the page at {PAGE_URL}", page))
    return next_steps(*steps)
