# SPDX-License-Identifier: MIT
"""Claims: who works on which episode, so that several processes on one folder share the work.

A claim is a file beside the parts, which its owner renews while it works. One that has not been renewed for a while is
void, and one whose process has ended on this machine is void at once. A claim only saves work: if two processes label
the same episode after all, both write the same part.
"""

from __future__ import annotations

import json
import os
import socket
import threading
from contextlib import suppress
from datetime import datetime, timezone
from types import TracebackType

from rfm_client.labelling.finished_episodes import Parts
from rfm_client.labelling.plan import Item

EXPIRY_S = 60.0
RENEWAL_S = 15.0

_SUFFIX = ".claim"


class Claims:
    """The claims of this process; as a context manager it renews them, and gives them back at the end."""

    def __init__(self, parts: Parts, *, expiry_s: float = EXPIRY_S, renewal_s: float = RENEWAL_S) -> None:
        self._parts = parts
        self._expiry_s, self._renewal_s = expiry_s, renewal_s
        self._owner = json.dumps({"host": socket.gethostname(), "pid": os.getpid()}).encode()
        self._held: set[str] = set()
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._renewing = threading.Thread(target=self._renew, name="rfm-claims", daemon=True)

    def take(self, item: Item) -> bool:
        """Whether this process may label the episode now. Raises OSError, with what to do."""
        path = self._path(item)
        if self._create(path):
            return True
        try:
            if not self._is_void(path):
                return False
            self._remove(path)
        except OSError as error:
            got = f"{error.strerror or error}: delete it if no process labels this dataset"
            raise OSError(f"{path}: expected a claim that can be read and deleted, got {got}") from error
        return self._create(path)

    def told(self, item: Item) -> str:
        """Who claims the episode, since when, and how one ends that."""
        path = self._path(item)
        try:
            owner, age_s = self._parts.fs.cat_file(path).decode(errors="replace"), self._age_s(path)
        except FileNotFoundError:
            return f"{path}: given back by now"
        advice = f"it is void {self._expiry_s:.0f} s after that; if that process is gone, you may delete the file"
        return f"{path}: claimed by {owner}, whose last sign of life was {age_s:.0f} s ago: {advice}"

    def give_back(self, item: Item) -> None:
        """Ends the claim, so that others may work on the episode."""
        path = self._path(item)
        with self._lock:
            self._held.discard(path)
        self._remove(path)

    def __enter__(self) -> Claims:
        self._renewing.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._ended.set()
        self._renewing.join()
        for path in sorted(self._held):
            self._remove(path)

    def _create(self, path: str) -> bool:
        try:
            with self._parts.writing(), self._parts.fs.open(path, "xb") as file:
                file.write(self._owner)
        except FileExistsError:
            return False
        with self._lock:
            self._held.add(path)
        return True

    def _is_void(self, path: str) -> bool:
        try:
            owner, age_s = self._parts.fs.cat_file(path), self._age_s(path)
        except FileNotFoundError:
            return True
        # one from the future is of a clock that is wrong, and would not expire for as long
        return abs(age_s) > self._expiry_s or _has_ended(owner)

    def _age_s(self, path: str) -> float:
        renewed: datetime = self._parts.fs.modified(path)
        return (datetime.now(timezone.utc) - _in_utc(renewed)).total_seconds()

    def _renew(self) -> None:
        while not self._ended.wait(self._renewal_s):
            with self._lock, suppress(OSError):  # a claim that cannot be renewed becomes void
                for path in self._held:
                    self._parts.fs.pipe_file(path, self._owner)

    def _remove(self, path: str) -> None:
        try:
            self._parts.fs.rm_file(path)
        except FileNotFoundError:
            return  # another process has found it void

    def _path(self, item: Item) -> str:
        return self._parts.path(item.key + _SUFFIX)


def _in_utc(time: datetime) -> datetime:
    return time.replace(tzinfo=timezone.utc) if time.tzinfo is None else time


def _has_ended(owner: bytes) -> bool:
    """Whether the owner was a process of this machine that is gone; one that cannot be read may live."""
    try:
        document = json.loads(owner)
        host, pid = document["host"], int(document["pid"])
    except (ValueError, LookupError, TypeError):
        return False
    if host != socket.gethostname():
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return False
