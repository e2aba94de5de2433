# SPDX-License-Identifier: MIT
"""What is reported of episodes that are watched, and the thread that reports it.

A report holds the steps that have come, 2000 at most, and the newest frame of each of the 16 episodes whose picture is
oldest. So what a report costs has a bound, however many environments there are.
"""

from __future__ import annotations

import atexit
import base64
import json
import logging
import os
import ssl
import threading
import time
import weakref
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from typing import Any, TypeAlias
from urllib.parse import urlsplit

from rfm_client.contract.samples import UInt8Array
from rfm_client.data.resize import as_jpeg
from rfm_client.transport.access import Access

PATH = "/live/reports"
REPORT_EVERY_S = 0.25
TRY_AGAIN_AFTER_S = 5.0
ANSWER_WITHIN_S = 5.0
CLOSE_WITHIN_S = 2.0
MOST_STEPS_KEPT = 10_000  # of all episodes together; the newest
MOST_STEPS = 2_000  # of one report
MOST_FRAMES = 16  # of one report
MOST_FRAMES_KEPT = 128  # as many episodes as a gateway keeps
MOST_RUNNING = 1024  # of which it is known that they run; the newest
MOST_ANSWER_BYTES = 300  # what a warning shows
LONGEST_PX = 256  # the longer side of a frame that is reported

About: TypeAlias = Mapping[str, Any]  # which episode it is
Entry: TypeAlias = tuple[About, Mapping[str, Any] | None]  # one of its steps; None: it has ended

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Address:
    """Where reports go. headers: shown with each of them; context: of HTTPS, None without"""

    url: str
    host: str
    port: int | None
    path: str
    headers: Mapping[str, str]
    context: ssl.SSLContext | None

    @classmethod
    def of(cls, url: str, access: Access) -> Address:
        """That of a gateway. Raises ValueError."""
        parts = urlsplit(url)
        if (
            parts.scheme not in ("http", "https")
            or not parts.hostname
            or "@" in parts.netloc
            or parts.query
            or parts.fragment
        ):
            raise ValueError(f"url: expected http://host:port or https://host:port of a gateway, got {url!r}")
        try:
            parts.hostname.encode("idna")
        except UnicodeError:
            raise ValueError(f"url: expected the name of a host, got {parts.hostname!r}") from None
        if parts.scheme == "http" and access.uses_tls:
            raise ValueError(f"url: expected https://host:port with certificates, got {url!r}")
        context = access.ssl_context if parts.scheme == "https" else None
        headers = {**access.shown, "content-type": "application/json"}
        return cls(url, parts.hostname, parts.port, parts.path.rstrip("/") + PATH, headers, context)

    def post(self, body: bytes) -> tuple[int, str]:
        """Status and text of the answer. Raises OSError, HTTPException."""
        connection = (
            HTTPConnection(self.host, self.port, timeout=ANSWER_WITHIN_S)
            if self.context is None
            else HTTPSConnection(self.host, self.port, timeout=ANSWER_WITHIN_S, context=self.context)
        )
        try:
            connection.request("POST", self.path, body, dict(self.headers))
            answer = connection.getresponse()
            return answer.status, answer.read(MOST_ANSWER_BYTES).decode(errors="replace")
        finally:
            connection.close()


class Reporter:
    """Reports to one address, in a thread of its own."""

    def __init__(self, address: Address) -> None:
        self._address = address
        self._steps: deque[Entry] = deque(maxlen=MOST_STEPS_KEPT)
        self._frames: dict[str, UInt8Array] = {}  # by episode; first the one that has waited longest
        self._running: dict[str, About] = {}
        self._lock = threading.Lock()
        self._has_more, self._stopping = threading.Event(), threading.Event()
        self._is_away = False
        self._process_id = os.getpid()
        self._thread = threading.Thread(target=self._run, name="rfm-live-view", daemon=True)
        self._thread.start()
        _open.add(self)

    def add(self, about: About, step: Mapping[str, Any], frame: UInt8Array) -> None:
        """Has a step reported, and ``frame`` unless a newer one comes before."""
        if self._stopping.is_set() or self._was_forked():
            return
        with self._lock:
            self._steps.append((about, step))
            self._frames[about["id"]], self._running[about["id"]] = frame, about
            _bound(self._frames, MOST_FRAMES_KEPT)
            _bound(self._running, MOST_RUNNING)
        self._has_more.set()

    def end(self, about: About) -> None:
        """Has it reported that an episode has ended, if it runs."""
        if self._was_forked():
            return
        with self._lock:
            if self._running.pop(about["id"], None) is not None:
                self._steps.append((about, None))
            if self._is_away:  # large frames of past episodes must not pile up
                self._frames.pop(about["id"], None)
        self._has_more.set()

    def close(self) -> None:
        """Ends all episodes, and the thread. Returns when that has been reported, or after CLOSE_WITHIN_S."""
        self.finish()
        self.join(CLOSE_WITHIN_S)

    def finish(self) -> None:
        """Has it reported that all episodes have ended, and then ends the thread. Returns at once."""
        if self._was_forked():
            return
        with self._lock:
            running = list(self._running.values())
        for about in running:
            self.end(about)
        self.stop()

    def join(self, timeout_s: float) -> None:
        """Returns when the thread has ended, or after so long."""
        if self._process_id == os.getpid():
            self._thread.join(timeout_s)

    def stop(self) -> None:
        """Ends the thread as soon as what is left has been reported, or cannot be."""
        self._stopping.set()
        self._has_more.set()

    @property
    def _has_any(self) -> bool:
        return bool(self._steps or self._frames)

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._has_more.wait()
            self._has_more.clear()
            has_arrived = self._report()
            if self._has_any:
                self._has_more.set()
            self._stopping.wait(REPORT_EVERY_S if has_arrived else TRY_AGAIN_AFTER_S)
        while self._has_any and self._report():
            continue

    def _report(self) -> bool:
        """Reports what there is, and says whether it has arrived. What has not is kept, unless it cannot arrive."""
        with self._lock:
            steps = [self._steps.popleft() for _ in range(min(len(self._steps), MOST_STEPS))]
            frames = {key: self._frames.pop(key) for key in list(self._frames)[:MOST_FRAMES]}
        if not steps and not frames:
            return True
        try:
            body = _body(steps, frames)
        except (TypeError, ValueError):  # which must not keep later steps from being reported
            logger.exception("%s: a live report has failed, and is dropped", self._address.url)
            return True
        try:
            status, text = self._address.post(body)
        except (OSError, HTTPException) as error:
            status, text = None, str(error) or type(error).__name__
        if status is not None and status < 300:
            self._is_away = False
            return True
        self._warn(text if status is None else f"{status} {text}")
        if status is None or status >= 500:  # others would be refused again
            self._put_back(steps, frames)
        return False

    def _was_forked(self) -> bool:
        """Whether this process has no thread that reports, since it was forked. It is told once."""
        if self._process_id == os.getpid() or self._stopping.is_set():
            return self._process_id != os.getpid()
        self._stopping.set()
        told = "%s: this LiveView was made in process %d, which forked this one: make one in each process"
        logger.warning(told, self._address.url, self._process_id)
        return True

    def _warn(self, reason: str) -> None:
        """Logs why reports do not arrive, once until they do."""
        if not self._is_away:
            expected = "%s: expected a gateway that takes live reports, got %s; episodes go on, and are not shown"
            logger.warning(expected, self._address.url, reason)
        self._is_away = True

    def _put_back(self, steps: list[Entry], frames: Mapping[str, UInt8Array]) -> None:
        with self._lock:
            self._steps = deque([*steps, *self._steps], MOST_STEPS_KEPT)
            self._frames = {key: frame for key, frame in frames.items() if key in self._running} | self._frames


_open: weakref.WeakSet[Reporter] = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    """Has the last steps reported before the process ends. A worker of multiprocessing ends without this."""
    reporters = list(_open)
    for reporter in reporters:
        reporter.finish()
    deadline_s = time.monotonic() + CLOSE_WITHIN_S
    for reporter in reporters:
        reporter.join(max(0.0, deadline_s - time.monotonic()))


def _bound(kept: dict[str, Any], most: int) -> None:
    if len(kept) > most:
        del kept[next(iter(kept))]


def _body(steps: list[Entry], frames: Mapping[str, UInt8Array]) -> bytes:
    episodes: dict[str, dict[str, Any]] = {}
    for about, step in steps:
        told = episodes.setdefault(about["id"], {**about, "ended": False, "steps": []})
        if step is None:
            told["ended"] = True
        else:
            told["steps"].append(step)
    pictures = {}
    for key, frame in frames.items():
        try:
            pictures[key] = base64.b64encode(as_jpeg(frame, LONGEST_PX)).decode()
        except (OSError, TypeError, ValueError):  # which must not keep the steps from being reported
            logger.exception("a live view: expected a frame uint8 [H, W, 3], got %s %s", frame.dtype, frame.shape)
    return json.dumps({"episodes": list(episodes.values()), "frames": pictures}, allow_nan=False).encode()
