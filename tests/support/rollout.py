# SPDX-License-Identifier: MIT
"""Two versions of a checkpoint on a server, and callers who compare answers with the named version's.

They send embeddings and raw frames in turn, a few requests a second, without retries.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import safetensors.torch
import torch

import goldens
import rfm_export
from callers import numbers
from engines import serve_config
from rfm import published
from rfm.engine import Engine, Outcome
from rfm_client import (
    AsyncRewardClient,
    DeadlineExceededError,
    RewardError,
    Sample,
)
from tolerances import TOLERANCE

NAME = "rfm"
WITH_ENCODERS = goldens.config("enc_c1_t1_disc10")
WIDTHS = (48, 32)
CALLERS = 8  # more would slow down the loading
PAUSE_S = 0.2  # a control loop's step


@dataclass
class Tally:
    """Outcomes of requests.

    unlike: answers of neither version, or of another version than the named one
    failed: requests without an answer; late: those past the deadline
    """

    asked: int = 0
    late: int = 0
    slowest_s: float = 0.0  # of answers
    by_version: Counter[str] = field(default_factory=Counter)
    unlike: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)

    @property
    def answered(self) -> int:
        return self.by_version.total()

    def __str__(self) -> str:
        versions = ", ".join(f"version {version}: {count}" for version, count in sorted(self.by_version.items()))
        return (
            f"asked {self.asked}, answered {self.answered} ({versions}), "
            f"of neither version {len(self.unlike)}, failed {len(self.failed)}, past their deadline {self.late}, "
            f"slowest answer {self.slowest_s:.1f} s"
        )


def other_checkpoint(folder: Path, source: Path = WITH_ENCODERS.checkpoint) -> Path:
    """Copy a checkpoint with other weights, also in the encoders."""
    folder.mkdir(parents=True)
    for file in source.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    weights = safetensors.torch.load_file(folder / "model.safetensors")
    random = torch.Generator().manual_seed(0)
    changed = {
        name: weight + 0.5 * weight.std() * torch.randn(weight.shape, generator=random) if weight.ndim == 2 else weight
        for name, weight in weights.items()
    }
    safetensors.torch.save_file(changed, folder / "model.safetensors", {"format": "pt"})
    return folder


def export(checkpoint: Path, repository: Path, name: str = NAME) -> int:
    return rfm_export.export(checkpoint, repository, serve_config(WITH_ENCODERS, name))


def answers(checkpoint: Path, samples: Sequence[Sample]) -> list[Outcome]:
    """Return the checkpoint's answers without a server."""
    serve = serve_config(WITH_ENCODERS)
    loaded = published.read(checkpoint, image_encoder=serve.image_encoder, text_encoder=serve.text_encoder)
    return Engine.of(loaded.checkpoint, encoders=loaded.encoders()).evaluate(samples)


def difference(left: object, right: object) -> float:
    return float(np.abs(numbers(left) - numbers(right)).max())


@contextmanager
def callers(
    url: str,
    samples: Sequence[Sample],
    expected: Mapping[str, Sequence[Outcome]],
    model: str = NAME,
    *,
    count: int = CALLERS,
    timeout_s: float | None = None,
) -> Iterator[Tally]:
    """Run ``count`` callers. expected: answers by version; timeout_s: None: the client's default"""
    tally, stop, begun = Tally(), threading.Event(), threading.Event()

    async def call(client: AsyncRewardClient, index: int) -> None:
        while not stop.is_set():
            sample = index % len(samples)
            index += count + 1
            tally.asked += 1
            asked_s = time.monotonic()
            try:
                result = await client.score(samples[sample], timeout_s=timeout_s)
            except RewardError as error:
                tally.failed.append(repr(error))
                tally.late += isinstance(error, DeadlineExceededError)
                continue
            tally.slowest_s = max(tally.slowest_s, time.monotonic() - asked_s)
            version = str(result.model_version)
            tally.by_version[version] += 1
            if version not in expected or difference(result, expected[version][sample]) > TOLERANCE:
                tally.unlike.append(f"{samples[sample]!r:.80} by version {version}: {numbers(result)}")
            begun.set()
            await asyncio.sleep(PAUSE_S)

    async def call_all() -> None:
        async with AsyncRewardClient(url, model=model, retry=False, max_in_flight=count) as client:
            await asyncio.gather(*(call(client, index) for index in range(count)))

    thread = threading.Thread(target=asyncio.run, args=(call_all(),))
    thread.start()
    try:
        assert begun.wait(60)
        yield tally
    finally:
        stop.set()
        thread.join()
