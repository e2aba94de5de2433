# SPDX-License-Identifier: MIT
"""``make chaos``: ``rfm export`` is killed (-9) at many moments; the repository can be served after each.

Two checkpoints with encoders are exported in turn into one repository. Every second kill comes at a random moment, the
others right before one of the steps in which files take their places. After each, a real Triton loads what the
repository then holds (which compares the weights with their digests), and gives the scores of one of the two.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import random
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from engines import serve_config
from rfm.launch.temporary import temporary_server
from rfm_client import ProgressSample, RewardClient, Trajectory
from rollout import TOLERANCE, WITH_ENCODERS, answers, difference, other_checkpoint

FRAMES = np.random.default_rng(0).integers(0, 256, (3, 32, 32, 3), np.uint8)
SAMPLES = [ProgressSample(Trajectory(frames=FRAMES, task="stack the cups"))]
SERVER = multiprocessing.get_context("forkserver")  # nothing happens to a repository while Python imports
SERVER.set_forkserver_preload(["killed_exports", "rfm_export", "transformers.models.dinov2.modeling_dinov2"])


class NotServableError(Exception):
    """A repository that no longer can be served as one of the checkpoints."""


def export(checkpoint: Path, repository: Path, steps: int | None) -> None:
    """``rfm export`` in a process of its own, which dies before step number ``steps`` if that is given."""
    import rfm_export

    remaining = itertools.count(steps if steps is not None else -1, -1)

    def dying(move: Callable[[Path, Path], Path]) -> Callable[[Path, Path], Path]:
        def moved(source: Path, target: Path) -> Path:
            if repository in Path(target).parents and next(remaining) == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return move(source, target)

        return moved

    Path.rename, Path.replace = dying(Path.rename), dying(Path.replace)  # type: ignore[assignment,method-assign]
    rfm_export.export(checkpoint, repository, serve_config(WITH_ENCODERS))


def run(checkpoint: Path, repository: Path, *, steps: int | None = None, after_s: float | None = None) -> bool:
    """One export; whether it was killed. Raises NotServableError if it failed otherwise."""
    process: Any = SERVER.Process(target=export, args=(checkpoint, repository, steps))
    process.start()
    process.join(after_s)
    if process.is_alive():
        process.kill()
    process.join()
    if process.exitcode not in (0, -signal.SIGKILL):
        raise NotServableError(f"expected an export or its kill, got exit status {process.exitcode}")
    return bool(process.exitcode)


def kill_exports(folder: Path, count: int, seed: int = 0) -> Iterator[str]:
    """What each kill met. Raises NotServableError."""
    choose, repository = random.Random(seed), folder / "model_repository"
    checkpoints = WITH_ENCODERS.checkpoint, other_checkpoint(folder / "other")
    expected = [answers(checkpoint, SAMPLES)[0] for checkpoint in checkpoints]
    if difference(*expected) <= TOLERANCE:
        raise NotServableError("expected two checkpoints that differ, got the same scores")

    def check() -> int:
        with (
            temporary_server(repository, folder / "triton.log") as endpoints,
            RewardClient(endpoints.grpc_url) as client,
        ):
            got = client.evaluate(SAMPLES)[0]
        found = [number for number, each in enumerate(expected) if difference(got, each) <= TOLERANCE]
        if not found:
            raise NotServableError(f"expected the scores of one of the checkpoints, got {got}")
        return found[0]

    run(checkpoints[1], repository)
    started_s = time.monotonic()
    run(checkpoints[0], repository)
    whole_s = time.monotonic() - started_s
    step = 0
    for number in range(count):
        if number % 2:
            killed = run(checkpoints[1], repository, steps=step)
            told, step = f"before step {step}", step + 1 if killed else 0
        else:
            after_s = choose.uniform(0, whole_s)
            killed, told = run(checkpoints[0], repository, after_s=after_s), f"after {after_s:.2f} s"
        yield f"{'killed' if killed else 'done'} {told}; checkpoint {check()} is served"
    run(checkpoints[0], repository)
    if left := list(repository.rglob(".export-*")):
        raise NotServableError(f"{repository}: expected no folders of killed exports, got {left}")
    yield f"a whole export at the end: checkpoint {check()} is served"
