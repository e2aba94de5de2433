# SPDX-License-Identifier: MIT
"""The page's requests to the gateway, and the command line's answers to the same questions."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import requests

from client_commands import invoke

SCORE, COMPARE, SERVED, SERVER = "viewer/score", "viewer/compare", "viewer/served", "viewer/server"

Json = dict[str, Any]


def post(url: str, path: str, files: dict[str, Path | bytes], **fields: Any) -> requests.Response:
    """Post a form like the page. Return the response as a stream."""
    with ExitStack() as stack:
        parts = {
            name: (f"{name}.mp4", file)
            if isinstance(file, bytes)
            else (file.name, stack.enter_context(file.open("rb")))
            for name, file in files.items()
        }
        return requests.post(f"{url}/{path}", data=fields, files=parts, stream=True, timeout=60)


def events(response: requests.Response) -> list[tuple[str, Json]]:
    """All server-sent events of an answer."""
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == "text/event-stream; charset=utf-8"
    told = []
    for event in response.text.split("\n\n")[:-1]:
        name, data = event.split("\n")
        told.append((name.removeprefix("event: "), json.loads(data.removeprefix("data: "))))
    return told


def curve_of(told: Sequence[tuple[str, Json]]) -> Json:
    """Return the curve from the events, after a check for missing and repeated steps."""
    (first, video), *others, (last, _) = told
    assert (first, last) == ("video", "done"), told
    progress: list[Any] = []
    success: list[Any] = []
    for name, points in others:
        assert (name, points["first"]) == ("scores", len(progress))
        progress += points["progress"]
        success += points["success"]
    assert video["num_frames"] == len(progress)
    return {"progress": progress, "success": success, "frame_times_s": video["times_s"]}


def run_line(folder: Path, command: str) -> list[str]:
    """Run a command line of ``rfm-client`` in this folder, as a user who copies it does. Return the words."""
    program, *words = shlex.split(command)
    assert program == "rfm-client"
    here = Path.cwd()
    os.chdir(folder)
    try:
        done = invoke(*words)
    finally:
        os.chdir(here)
    assert done.exit_code == 0, done.output
    return words


def by_command_line(folder: Path, command: str) -> Json:
    """Run a command line of ``rfm-client`` in this folder. Return the JSON that it writes."""
    words = run_line(folder, command)
    return dict(json.loads((folder / words[words.index("--json") + 1]).read_text()))
