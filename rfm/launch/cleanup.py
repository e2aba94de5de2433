# SPDX-License-Identifier: MIT
"""What ``rfm serve`` would leave behind if it is killed with -9: shared memory, folders."""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
import tempfile
from pathlib import Path

from rfm.launch.installation import ServerStartError

SHARED_MEMORY = Path("/dev/shm")
BACKENDS_PREFIX = "rfm-backends-"
# The Python backend's regions have this name. Newer Tritons let no client map a region with it.
REGION_PREFIX = "triton_python_backend_shm_region_rfm"

NEEDS_ROOM = "free some (a container has more of /dev/shm with --shm-size; TMPDIR names another folder than /tmp)"

_LOCK = "lock"
_NEW = "rfm-new"


class Claim:
    """What one server has on this machine beside its processes: regions of shared memory, and a folder.

    Each of the two has a lock, which is held as long as a process lives that has ``lock_files``: this one, and those
    that inherit them. A process id would prove nothing: another container may share the memory, or have left it.
    """

    def __init__(self) -> None:
        """Takes both. Raises ServerStartError where they cannot be written."""
        try:
            self._take()
        except OSError as error:
            raise ServerStartError(
                f"{error.filename}: expected room for a server's files, got: {error.strerror}; {NEEDS_ROOM}"
            ) from error

    def _take(self) -> None:
        pid, token = os.getpid(), secrets.token_hex(4)
        self.region_prefix = f"{REGION_PREFIX}_{pid}_{token}_"
        self._lock = SHARED_MEMORY / f"{self.region_prefix}{_LOCK}"
        self.backends = Path(tempfile.gettempdir(), f"{BACKENDS_PREFIX}{pid}-{token}")
        new_lock, new_folder = SHARED_MEMORY / f"{_NEW}-{pid}-{token}", self.backends.with_name(f"{_NEW}-{pid}-{token}")
        new_folder.mkdir(0o700)
        self.lock_files = [_locked(new_lock), _locked(new_folder / _LOCK)]
        new_lock.rename(self._lock)  # under these names they have always been locked
        new_folder.rename(self.backends)

    def release(self) -> None:
        """Removes the regions, the folder and their locks."""
        _remove(self._lock)
        _remove(self.backends / _LOCK)
        for file in self.lock_files:
            os.close(file)


def clear() -> list[Path]:
    """Removes what servers left of which no process lives, and gives their paths."""
    locks = [
        *SHARED_MEMORY.glob(f"{REGION_PREFIX}_*_{_LOCK}"),
        *Path(tempfile.gettempdir()).glob(f"{BACKENDS_PREFIX}*/{_LOCK}"),
    ]
    return [path for lock in locks if _is_free(lock) for path in _remove(lock)]


def _locked(file: Path) -> int:
    """A descriptor of the new ``file``, which is locked until it is closed, and all that were inherited from it."""
    descriptor = os.open(file, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    return descriptor


def _is_free(lock: Path) -> bool:
    try:
        with lock.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # held, another user's, or gone
        return False
    return True


def _remove(lock: Path) -> list[Path]:
    """Removes what a lock protects, and gives its paths. The lock goes last, so that a later attempt can finish."""
    try:
        if lock.parent == SHARED_MEMORY:
            removed = [path for path in SHARED_MEMORY.glob(f"{lock.name.removesuffix(_LOCK)}*") if path != lock]
            for path in (*removed, lock):
                path.unlink(missing_ok=True)
            return removed
        shutil.rmtree(lock.parent)
    except OSError:  # another user's, or gone
        return []
    return [lock.parent]
