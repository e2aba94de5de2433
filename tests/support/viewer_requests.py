# SPDX-License-Identifier: MIT
"""What the page asks the gateway, and the answers that the command line gives to the same questions."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import requests

SCORE, COMPARE, SERVED = "viewer/score", "viewer/compare", "viewer/served"

Json = dict[str, Any]


def post(url: str, path: str, files: dict[str, Path | bytes], headers: Json | None = None, **fields: Any) -> Any:
    """The response to a form of the page, whose answer is read as it comes."""
    with ExitStack() as stack:
        parts = {
            name: (f"{name}.mp4", file)
            if isinstance(file, bytes)
            else (file.name, stack.enter_context(file.open("rb")))
            for name, file in files.items()
        }
        return requests.post(f"{url}/{path}", data=fields, files=parts, headers=headers, stream=True, timeout=60)


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
    """The curve that the events tell, of which none is missing and none comes twice."""
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


def by_command_line(folder: Path, command: str) -> None:
    """Runs a command line of ``rfm-client`` in the folder."""
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        shlex.split(command), cwd=folder, env=environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
