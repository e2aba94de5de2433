# SPDX-License-Identifier: MIT
"""Live view: running episodes report their newest frames and scores to the page of a gateway.

A thread reports a few times a second, so that no step waits. A report holds at most 2000 new steps, and the newest
frames of the 16 episodes that have waited longest. So its cost is bounded for any number of environments.
"""

from __future__ import annotations

import atexit
import base64
import io
import json
import logging
import math
import operator
import os
import threading
import uuid
import weakref
from collections import deque
from collections.abc import Mapping
from contextlib import AbstractContextManager
from functools import partial
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import urlsplit

import numpy as np
from PIL import Image

from rfm_client import FRAME_SCORES, UInt8Array
from rfm_client.episodes import StepScore, SuccessRule
from rfm_client.options import checked_count, require
from rfm_client.serving import Credentials

PATH = "/live/reports"
REPORT_EVERY_S = 0.25
TRY_AGAIN_AFTER_S = 5.0
ANSWER_WITHIN_S = 5.0
CLOSE_WITHIN_S = 2.0
MOST_STEPS_KEPT = 10_000  # newest steps, of all episodes together
MOST_STEPS = 2_000  # of one report
MOST_FRAMES = 16  # of one report
MOST_FRAMES_KEPT = 128  # as many episodes as a gateway keeps
MOST_RUNNING = 1024  # newest episodes that are known to run
MOST_ANSWER_BYTES = 300  # in a warning
MOST_LETTERS = 2000  # of a text that a gateway takes
LONGEST_PX = 256  # longer side of a reported frame
JPEG_QUALITY = 85

About: TypeAlias = Mapping[str, Any]  # identity of an episode
Entry: TypeAlias = tuple[About, Mapping[str, Any] | None]  # its step, or what was paid; None: it has ended

logger = logging.getLogger(__name__)


class LiveEpisode:
    """One episode in a live view. ``LiveView.episode`` builds it."""

    def __init__(self, view: LiveView, reporter: Reporter, about: About) -> None:
        self._view = view  # keeps the view, and so the reporter, alive
        self._reporter, self._about = reporter, about
        self._has_ended = False
        self._total_reward = 0.0

    def add(self, frame: UInt8Array, score: StepScore) -> None:
        """Queue a step for the reports, unless the episode has ended. Return at once, and raise nothing.

        frame: uint8 [H, W, 3], which must not change any more
        """
        if self._has_ended:
            return
        scores = {"progress": _or_none(score.progress), "success": _or_none(score.success)}
        step: dict[str, Any] = {"step": score.step, **scores, "succeeded": score.succeeded, "ms": score.ms}
        instead = FRAME_SCORES["progress"].replaced_by
        if scores["progress"] is None and instead in score.more_scores:
            step["instead"] = {instead: score.more_scores[instead]}
        self._reporter.add(self._about, step, np.asarray(frame))

    def pay(self, reward: float) -> None:
        """Queue a reward that the policy got for the reports, also after the end. Return at once, and raise nothing.

        The page adds up the rewards of an episode to its return. Episodes without a reward have none.
        """
        self._total_reward += reward
        newest, total = _or_none(reward), _or_none(self._total_reward)
        if newest is not None and total is not None:
            self._reporter.pay(self._about, {"reward": newest, "total_reward": total})

    def end(self) -> None:
        """Queue the end of the episode for the reports. Return at once, and raise nothing."""
        self._has_ended = True
        self._reporter.end(self._about)


class LiveView(AbstractContextManager["LiveView"]):
    """The tab Live of a gateway's page, for episodes: ``client.episode(task, live=LiveView("http://robot:8100"))``.

    A view serves any number of episodes and clients, with at most four reports a second in all. It reports the scores
    of every step, and the newest frame of each episode, at most 256 pixels on its longer side. If the gateway cannot be
    reached, the episodes go on, a warning is logged, and the newest 10 000 steps are kept.

    url: ``http://host:port`` or ``https://host:port`` of the gateway
    name: the run's name on the page
    others: as of a client; ``api_key`` is the gateway's key

    A context manager. It can be pickled: each process then reports by itself. A forked process reports nothing, and
    logs a warning.
    Raises ValueError for unusable arguments.
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
        self.name = name
        self._url = url
        self._credentials = Credentials(ca_file, client_certificate, client_key, headers or {}, api_key)
        self._reporter = Reporter(url, self._credentials)
        weakref.finalize(self, self._reporter.stop).atexit = False  # at exit, _close_all closes the reporter

    def episode(self, task: str, env: int = 0, threshold: float = 0.5) -> LiveEpisode:
        """Return a new episode, which appears on the page with its first step.

        env: number of its environment, from 0
        threshold: least success that counts as success; inf: none does

        Raises ValueError.
        """
        checked_count("env", env, least=0)
        if threshold != math.inf:
            SuccessRule(threshold)  # raises ValueError
        about = {"name": _shown(self.name), "task": _shown(task)}
        numbers = {"env": operator.index(env), "threshold": _or_none(threshold)}
        return LiveEpisode(self, self._reporter, {"id": uuid.uuid4().hex, **about, **numbers})

    def close(self) -> None:
        """End the episodes. Return after the last report, or after two seconds. Later steps are not reported."""
        self._reporter.close()

    def __exit__(self, *_raised: object) -> None:
        self.close()

    def __reduce__(self) -> tuple[object, ...]:
        return partial(LiveView, self._url, name=self.name, **self._credentials.options), ()


class Reporter:
    """Reports to one gateway, in a thread of its own. Raises ValueError for an invalid URL."""

    def __init__(self, url: str, credentials: Credentials) -> None:
        self._url, self._credentials = url, credentials
        self._parts = urlsplit(url)
        is_plain = "@" not in self._parts.netloc and not self._parts.query and not self._parts.fragment
        is_url = self._parts.scheme in ("http", "https") and bool(self._parts.hostname) and is_plain
        require("url", is_url, "http://host:port or https://host:port of a gateway", repr(url))
        is_secure = self._parts.scheme == "https" or not credentials.uses_tls
        require("url", is_secure, "https://host:port with certificates", repr(url))
        self._port = self._parts.port  # raises ValueError if out of range
        self._headers = {**credentials.shown, "content-type": "application/json"}
        self._steps: deque[Entry] = deque(maxlen=MOST_STEPS_KEPT)
        self._frames: dict[str, UInt8Array] = {}  # by episode; the longest waiting first
        self._running: dict[str, About] = {}
        self._lock = threading.Lock()
        self._has_more, self._stopping = threading.Event(), threading.Event()
        self._is_away = False
        self._process_id = os.getpid()
        self._thread = threading.Thread(target=self._run, name="rfm-live-view", daemon=True)
        self._thread.start()
        _open.add(self)

    def add(self, about: About, step: Mapping[str, Any], frame: UInt8Array) -> None:
        """Queue a step, and its frame, uint8 [H, W, 3], unless a newer frame replaces it."""
        if self._stopping.is_set() or self._was_forked():
            return
        with self._lock:
            self._steps.append((about, step))
            self._frames[about["id"]], self._running[about["id"]] = frame, about
            for kept, most in ((self._frames, MOST_FRAMES_KEPT), (self._running, MOST_RUNNING)):
                if len(kept) > most:
                    del kept[next(iter(kept))]
        self._has_more.set()

    def pay(self, about: About, paid: Mapping[str, float]) -> None:
        """Queue the newest reward of an episode, and the sum so far."""
        if self._stopping.is_set() or self._was_forked():
            return
        with self._lock:
            self._steps.append((about, paid))
        self._has_more.set()

    def end(self, about: About) -> None:
        """Queue the end of an episode, if it runs."""
        if self._was_forked():
            return
        with self._lock:
            if self._running.pop(about["id"], None) is not None:
                self._steps.append((about, None))
            if self._is_away:  # large frames of past episodes must not pile up
                self._frames.pop(about["id"], None)
        self._has_more.set()

    def close(self) -> None:
        """Report the end of all episodes. Return after the last report, or after CLOSE_WITHIN_S."""
        if self._was_forked():
            return
        with self._lock:
            running = list(self._running.values())
        for about in running:
            self.end(about)
        self.stop()
        self._thread.join(CLOSE_WITHIN_S)

    def stop(self) -> None:
        """End the thread after the last report, or a failed report."""
        self._stopping.set()
        self._has_more.set()

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._has_more.wait()
            self._has_more.clear()
            has_arrived = self._report()
            if self._steps or self._frames:
                self._has_more.set()
            self._stopping.wait(REPORT_EVERY_S if has_arrived else TRY_AGAIN_AFTER_S)
        while (self._steps or self._frames) and self._report():
            continue

    def _report(self) -> bool:
        """Send a report. False: it did not arrive; its content is kept unless the gateway would refuse it again."""
        with self._lock:
            steps = [self._steps.popleft() for _ in range(min(len(self._steps), MOST_STEPS))]
            frames = {key: self._frames.pop(key) for key in list(self._frames)[:MOST_FRAMES]}
        if not steps and not frames:
            return True
        try:
            body = report_body(steps, frames)
        except (OSError, TypeError, ValueError):  # must not block later reports
            logger.exception("%s: a live report has failed, and is dropped", self._url)
            return True
        try:
            status, text = self._post(body)
        except (OSError, HTTPException, ValueError) as error:  # ValueError: an invalid host name
            status, text = None, str(error) or type(error).__name__
        if status is not None and status < 300:
            self._is_away = False
            return True
        self._warn(text if status is None else f"{status} {text}")
        if status is None or status >= 500:  # a refusal would come again
            with self._lock:
                self._steps = deque([*steps, *self._steps], MOST_STEPS_KEPT)
                self._frames = {key: frame for key, frame in frames.items() if key in self._running} | self._frames
        return False

    def _post(self, body: bytes) -> tuple[int, str]:
        host = self._parts.hostname or ""
        connection = (
            HTTPSConnection(host, self._port, timeout=ANSWER_WITHIN_S, context=self._credentials.ssl_context)
            if self._parts.scheme == "https"
            else HTTPConnection(host, self._port, timeout=ANSWER_WITHIN_S)
        )
        try:
            connection.request("POST", self._parts.path.rstrip("/") + PATH, body, self._headers)
            answer = connection.getresponse()
            return answer.status, answer.read(MOST_ANSWER_BYTES).decode(errors="replace")
        finally:
            connection.close()

    def _was_forked(self) -> bool:
        """True in a forked process, which has no reporting thread. Logs a warning once."""
        if self._process_id == os.getpid() or self._stopping.is_set():
            return self._process_id != os.getpid()
        self._stopping.set()
        told = "%s: this LiveView was made in process %d, which forked this one: make one in each process"
        logger.warning(told, self._url, self._process_id)
        return True

    def _warn(self, reason: str) -> None:
        if not self._is_away:
            expected = "%s: expected a gateway that takes live reports, got %s; episodes go on, and are not shown"
            logger.warning(expected, self._url, reason)
        self._is_away = True


_open: weakref.WeakSet[Reporter] = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    """Report the last steps before the process ends. A worker of multiprocessing ends without this."""
    for reporter in list(_open):
        reporter.close()


def report_body(steps: list[Entry], frames: Mapping[str, UInt8Array]) -> bytes:
    """Return a report as a gateway takes it: JSON of episodes with their new steps, and JPEG frames by episode."""
    episodes: dict[str, dict[str, Any]] = {}
    for about, step in steps:
        told = episodes.setdefault(about["id"], {**about, "ended": False, "steps": []})
        if step is None:
            told["ended"] = True
        elif "total_reward" in step:
            told |= step
        else:
            told["steps"].append(step)
    pictures = {key: base64.b64encode(_jpeg(frame)).decode() for key, frame in frames.items()}
    return json.dumps({"episodes": list(episodes.values()), "frames": pictures}, allow_nan=False).encode()


def _jpeg(frame: UInt8Array) -> bytes:
    """A frame, uint8 [H, W, 3], as a JPEG file with at most LONGEST_PX pixels on its longer side."""
    image = Image.fromarray(frame)
    image.thumbnail((LONGEST_PX, LONGEST_PX))
    file = io.BytesIO()
    image.save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)  # full resolution of colours
    return file.getvalue()


def _or_none(score: float) -> float | None:
    """A score or threshold for JSON; None unless finite."""
    return float(score) if math.isfinite(score) else None


def _shown(text: str) -> str:
    """A text as a gateway takes it: short, in valid UTF-8."""
    return text[:MOST_LETTERS].encode(errors="replace").decode()
