# SPDX-License-Identifier: MIT
"""Change a file while other programs may write to it, without losing their changes.

A changed copy replaces the file if the file has not changed since it was copied; otherwise it is copied again. HDF5
programs lock (``flock``) files that are open for writing. On file systems without locks, only the comparison remains,
which finds all changes made before the replacement.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

PATIENCE_S = 60.0  # with another program's open file

_TRIES = 5
_PAUSE_S = 0.1
_KEPT = "Nothing has changed; the same command then writes the labels without scoring again"


class BusyError(OSError):
    """Other programs write into the file. It has not changed."""


def rewrite(target: Path, change: Callable[[Path], None], note: Callable[[str], None]) -> None:
    """Replace a file with a changed copy in one step. Other runs that do the same wait.

    change: changes the copy; called again for a later copy
    note: called with a line about each wait

    Raises BusyError if others have the file open for writing for PATIENCE_S, or change it at every try; what ``change``
    raises; OSError for a full disk.
    """
    with _alone(target, note):
        for _ in range(_TRIES):
            with _without_writers(target, note):
                before = _state(target)
            written = target.with_name(f".tmp-{uuid.uuid4().hex}")
            try:
                shutil.copy2(target, written)
                change(written)
                with written.open("rb") as whole:
                    os.fsync(whole.fileno())
                with _without_writers(target, note):
                    if _state(target) == before:
                        written.replace(target)
                        return
            except (OSError, RuntimeError, ValueError, KeyError) as error:
                if isinstance(error, BusyError) or _state(target) == before:
                    raise  # not the error of a copy that was made while another program wrote
            finally:
                written.unlink(missing_ok=True)
            note(f"{target} has changed in the meantime: copying it again")
    got = f"changes at each of {_TRIES} tries"
    raise BusyError(f"{target}: expected a file that other programs leave alone, got {got}. {_KEPT}")


def _state(target: Path) -> tuple[int, int, int, int]:
    status = target.stat()
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


@contextmanager
def _alone(target: Path, note: Callable[[str], None]) -> Iterator[None]:
    """Wait until no other run is in this block for the same file. The run removes its lock file at the end."""
    file = target.with_name(f".{target.name}.lock")
    while True:
        with file.open("ab") as lock:
            _lock(lock, fcntl.LOCK_EX, lambda: note(f"{target}: waiting for another run that writes labels into it"))
            try:
                is_current = os.path.samestat(os.fstat(lock.fileno()), file.stat())
            except FileNotFoundError:
                is_current = False
            if is_current:  # else another run has removed it, and a third may have made a new one
                try:
                    yield
                finally:
                    file.unlink(missing_ok=True)
                return


@contextmanager
def _without_writers(target: Path, note: Callable[[str], None]) -> Iterator[None]:
    """Wait until no program of HDF5 has the file open for writing. Raises BusyError."""
    busy = f"{target}: waiting for another program that has it open for writing"
    with target.open("rb") as opened:
        if not _lock(opened, fcntl.LOCK_SH, lambda: note(busy), PATIENCE_S):
            expected = "a file that no other program has open for writing"
            raise BusyError(f"{target}: expected {expected}, got an open one: close it there. {_KEPT}")
        yield


def _lock(opened: Any, kind: int, on_wait: Callable[[], None], patience_s: float = float("inf")) -> bool:
    """Wait for a lock, which ends when the file is closed. False: others held it for ``patience_s``.

    True also for a file system without locks. on_wait: called before the first pause
    """
    until_s, waits = time.monotonic() + patience_s, False
    while True:
        try:
            fcntl.flock(opened, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= until_s:
                return False
            if not waits:
                on_wait()
            waits = True
            time.sleep(_PAUSE_S)
        except OSError:
            return True
        else:
            return True
