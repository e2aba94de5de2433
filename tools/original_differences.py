# SPDX-License-Identifier: MIT
"""``make differences``: answers of the gateway beside those of the original evaluation server, as a Markdown table.

Sends the recorded requests of public clients, and requests on which the two servers are known to differ. Without
``--original`` the original's answers to the recorded requests are those in tests/gateway/field_clients/expect.json, and
the other requests are sent to the gateway alone.

original_differences.py [--gateway URL] [--original URL]
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import requests

import goldens
import rfm_export
from engines import serve_config
from field_clients import CHECKPOINT, EVALUATIONS, WITHIN_S, FieldRequest, Scores
from gateway_requests import multipart
from gateways import running
from rfm_gateway.blank_frames import WARNING_HEADER
from servers import start_triton

TASK = "put the red cup on the plate"
NOT_ASKED = "not asked"


@dataclass(frozen=True)
class Answer:
    """The answer of one server: scores with a warning, or the reason of a refusal."""

    status: int
    scores: Scores | None = None
    told: str = ""

    @classmethod
    def of(cls, status: int, body: bytes, warning: str | None = None) -> Answer:
        """Read an answer of any status."""
        if status == 200:
            return cls(status, Scores.of(json.loads(body)), warning or "")
        try:
            detail = json.loads(body)["detail"]
        except (ValueError, KeyError):
            return cls(status)
        return cls(status, told=detail if isinstance(detail, str) else detail[0]["msg"])

    def __str__(self) -> str:
        return f"{self.status}: {self.told}" if self.told else str(self.status)


def frames(seed: int, num_frames: int = 6, channels: int = 3) -> Any:
    """Return uint8 [T, 32, 32, C] of coloured tiles, which change slowly."""
    random = np.random.default_rng(seed)
    tiles = random.integers(0, 256, (num_frames + 4, 4, channels), np.uint8)
    clip = np.stack([tiles[index : index + 4] for index in range(num_frames)])
    return clip.repeat(8, axis=1).repeat(8, axis=2)


def progress(clip: Any, task: str | None = TASK) -> dict[str, Any]:
    return {"sample_type": "progress", "trajectory": {"frames": clip, "frames_shape": list(clip.shape), "task": task}}


def pair(first: Any, second: Any) -> dict[str, Any]:
    chosen, rejected = (progress(clip)["trajectory"] for clip in (first, second))
    return {"sample_type": "preference", "chosen_trajectory": chosen, "rejected_trajectory": rejected}


def transparent(alpha: int) -> Any:
    clip = frames(1, channels=4)
    clip[..., 3] = alpha
    return clip


CASES: dict[str, tuple[list[dict[str, Any]], dict[str, str]]] = {  # samples, and other fields of the form
    "one clip": ([progress(frames(1))], {}),
    "clips of two lengths": ([progress(frames(1)), progress(frames(2, 4))], {}),
    "one frame, `use_frame_steps`": ([progress(frames(1, 1))], {"use_frame_steps": "true"}),
    "a preference, `use_frame_steps`": ([pair(frames(1), frames(2)), progress(frames(1))], {"use_frame_steps": "true"}),
    "`use_frame_steps` yes": ([progress(frames(1))], {"use_frame_steps": "yes"}),
    "alpha 255": ([progress(transparent(255))], {}),
    "alpha 128": ([progress(transparent(128))], {}),
    "alpha 0": ([progress(transparent(0))], {}),
    "task null": ([progress(frames(1), None)], {}),
    "task empty": ([progress(frames(1), "")], {}),
    "floats in 0..255": ([progress(frames(1).astype(np.float32))], {}),
    "floats in 0..1": ([progress((frames(1) / 255).astype(np.float32))], {}),
    "floats in 0..1 that became uint8": ([progress((frames(1) / 255).astype(np.uint8))], {}),
    "whole numbers above 255": ([progress(frames(1).astype(np.int32) * 2)], {}),
    "true and false": ([progress(frames(1) > 127)], {}),
    "[T, 3, H, W]": ([progress(frames(1).transpose(0, 3, 1, 2))], {}),
    "60 frames": ([progress(frames(1, 60))], {}),
    "frames of 640 pixels": ([progress(frames(1, 2).repeat(20, axis=1).repeat(20, axis=2))], {}),
}


def posted(url: str, samples: list[dict[str, Any]], fields: dict[str, str]) -> Answer:
    files, form = multipart(samples, **fields)
    response = requests.post(f"{url}/evaluate_batch_npy", files=files, data=form, timeout=WITHIN_S)
    return Answer.of(response.status_code, response.content, response.headers.get(WARNING_HEADER))


def recorded(request: FieldRequest, original: str | None) -> Answer:
    """Return the original's answer: its own, or the recorded status and scores."""
    if original is not None:
        return asked(request, original)
    status = request.expected["original_server_status"]
    return Answer(status, request.original, "" if status == 200 else "each sample alone 200")


def asked(request: FieldRequest, url: str) -> Answer:
    status, headers, body = request.sent(url)
    return Answer.of(status, body, headers.get(WARNING_HEADER.lower()))


def rows(gateway: str, original: str | None) -> Iterator[tuple[str, str, str, str]]:
    """Yield request, answer of the original, answer here, and the largest difference of scores."""
    for request in EVALUATIONS:
        yield compared(str(request), recorded(request, original), asked(request, gateway))
    for name, (samples, fields) in CASES.items():
        there = None if original is None else posted(original, samples, fields)
        yield compared(name, there, posted(gateway, samples, fields))


def compared(name: str, there: Answer | None, here: Answer) -> tuple[str, str, str, str]:
    both = there is not None and there.scores is not None and here.scores is not None
    difference = f"{here.scores.difference(there.scores):.1e}" if both else ""
    return name, NOT_ASKED if there is None else str(there), str(here), difference


def main(show: Callable[[str], None] = print) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gateway", help=f"URL of a gateway before {CHECKPOINT}; else one is started")
    parser.add_argument("--original", help="URL of the original server with the same weights")
    arguments = parser.parse_args()
    with ExitStack() as held:
        url = arguments.gateway or started(held)
        show("| request | original server | gateway | largest difference |")
        show("|---|---|---|---|")
        for row in rows(url, arguments.original):
            show(f"| {' | '.join(each.replace('|', '/') for each in row)} |")


def started(held: ExitStack) -> str:
    """Start Triton and a gateway until the context ends. Return the gateway's URL."""
    folder = Path(held.enter_context(tempfile.TemporaryDirectory()))
    config = goldens.config(CHECKPOINT)
    rfm_export.export(config.checkpoint, folder / "model_repository", serve_config(config, CHECKPOINT))
    server = held.enter_context(start_triton(folder / "model_repository"))
    return held.enter_context(running(server.endpoints, folder, CHECKPOINT)).url


if __name__ == "__main__":
    main()
