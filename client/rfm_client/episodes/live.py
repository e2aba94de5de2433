# SPDX-License-Identifier: MIT
"""Episodes that somebody watches while they run: their newest frames and scores go to the page of a gateway.

Whoever adds a step never waits for that: a thread reports, a few times a second, what has come since.
"""

from __future__ import annotations

import math
import operator
import uuid
import weakref
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from rfm_client.contract.numbers import checked_count, checked_share
from rfm_client.contract.samples import UInt8Array
from rfm_client.data.resize import load_pillow
from rfm_client.episodes.live_reports import Address, Reporter
from rfm_client.episodes.scores import StepScore
from rfm_client.transport.access import Access

MOST_LETTERS = 2000  # that a gateway takes


class LiveEpisode:
    """One episode that is watched. Built by ``LiveView.episode``."""

    def __init__(self, view: LiveView, task: str, env: int, threshold: float) -> None:
        self._view = view
        self._about = {
            "id": uuid.uuid4().hex,
            "name": _shown(view.name),
            "env": operator.index(env),
            "task": _shown(task),
            "threshold": _or_none(threshold),
        }
        self._has_ended = False

    def add(self, frame: UInt8Array, score: StepScore) -> None:
        """Has a step reported, unless the episode has ended. Returns at once, and raises nothing.

        frame: uint8 [H, W, 3], not written to any more
        """
        if self._has_ended:
            return
        scores = {"progress": _or_none(score.progress), "success": _or_none(score.success)}
        step = {"step": score.step, **scores, "succeeded": score.succeeded, "ms": score.ms}
        self._view._reporter.add(self._about, step, np.asarray(frame))

    def end(self) -> None:
        """Has it reported that no step will follow. Returns at once, and raises nothing."""
        self._has_ended = True
        self._view._reporter.end(self._about)


class LiveView:
    """The tab Live of a gateway's page, for episodes: ``client.episode(task, live=LiveView("http://robot:8100"))``.

    One view serves any number of episodes and clients. It reports at most four times a second, for all together: the
    scores of every step, and of each episode the newest frame, with at most 256 pixels on its longer side. If the
    gateway cannot be reached, the episodes go on; a warning is logged, and the newest 10 000 steps are kept.

    url: ``http://host:port`` or ``https://host:port`` of the gateway
    name: what the page calls the run
    others: as of a client; ``api_key`` is the gateway's key

    A context manager that closes it. It may be pickled: each process then reports by itself. A process that was forked
    reports nothing, and logs a warning.
    Raises ValueError for what cannot be used, ImportError without Pillow (``rfm-client[resize]``).
    """

    def __init__(
        self,
        url: str,
        *,
        name: str = "",
        ca_file: str | Path | None = None,
        client_certificate: str | Path | None = None,
        client_key: str | Path | None = None,
        headers: Mapping[str, str] | None = None,
        api_key: str | None = None,
    ) -> None:
        load_pillow()
        self.name = name
        self._url = url
        self._access = Access(ca_file, client_certificate, client_key, headers or {}, api_key)
        self._reporter = Reporter(Address.of(url, self._access))
        weakref.finalize(self, self._reporter.stop).atexit = False  # the reporter closes itself then

    def episode(self, task: str, env: int = 0, threshold: float = 0.5) -> LiveEpisode:
        """An episode that appears with its first step.

        env: number of its environment, from 0; threshold: at which success counts; inf: never

        Raises ValueError.
        """
        checked_count("env", env, least=0)
        if threshold != math.inf:
            checked_share("threshold", threshold)
        return LiveEpisode(self, task, env, threshold)

    def close(self) -> None:
        """Ends the episodes, and returns when the last report has gone out, or after two seconds. What comes later is
        not reported.
        """
        self._reporter.close()

    def __enter__(self) -> LiveView:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuilt, (self._url, self.name, self._access.options)


def _rebuilt(url: str, name: str, access: dict[str, Any]) -> LiveView:
    return LiveView(url, name=name, **access)


def _or_none(score: float) -> float | None:
    """A score or threshold as JSON has it: null for one that there is not."""
    return float(score) if math.isfinite(score) else None


def _shown(text: str) -> str:
    """A text as a gateway takes it."""
    return text[:MOST_LETTERS].encode(errors="replace").decode()
