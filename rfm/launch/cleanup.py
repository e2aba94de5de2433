# SPDX-License-Identifier: MIT
"""What ``rfm serve`` would leave in shared memory if it is killed with -9."""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
from pathlib import Path

from rfm.launch.installation import ServerStartError

SHARED_MEMORY = Path("/dev/shm")
# The Python backend's regions have this name. Newer Tritons let no client map a region with it.
REGION_PREFIX = "triton_python_backend_shm_region_rfm"
NEEDS_ROOM = "free some (a container has more of /dev/shm with --shm-size)"

_LOCK = "lock"


class Claim:
    """What one server has in shared memory: the backend's regions, and a folder for ``Installation``.

    A lock is held while a process with ``lock_file`` lives: this process, and those that inherit it. A process id
    would prove nothing: another container may share the memory, or have left it.
    """

    def __init__(self) -> None:
        """Takes it. Raises ServerStartError where nothing can be written."""
        name = f"{os.getpid()}_{secrets.token_hex(4)}"
        self.region_prefix = f"{REGION_PREFIX}_{name}_"
        self.backends = SHARED_MEMORY / f"{self.region_prefix}backends"
        self._lock = SHARED_MEMORY / f"{self.region_prefix}{_LOCK}"
        new_lock = SHARED_MEMORY / f"rfm-new-{name}"
        try:
            self.lock_file = os.open(new_lock, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600)
            fcntl.flock(self.lock_file, fcntl.LOCK_EX)
            new_lock.rename(self._lock)  # under this name it has always been locked
            self.backends.mkdir(0o700)
        except OSError as error:
            raise ServerStartError(
                f"{error.filename}: expected room for a server's files, got: {error.strerror}; {NEEDS_ROOM}"
            ) from error

    def release(self) -> None:
        """Removes the regions, the folder and the lock."""
        _remove(self._lock)
        os.close(self.lock_file)


def clear() -> list[Path]:
    """Removes what servers left of which no process lives, and gives its paths."""
    locks = [lock for lock in SHARED_MEMORY.glob(f"{REGION_PREFIX}_*_{_LOCK}") if _is_free(lock)]
    return [path for lock in locks for path in _remove(lock)]


def _is_free(lock: Path) -> bool:
    try:
        with lock.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # held, another user's, or gone
        return False
    return True


def _remove(lock: Path) -> list[Path]:
    """Removes what a lock protects, and gives its paths. The lock goes last, so that a later attempt can finish."""
    removed = [path for path in lock.parent.glob(f"{lock.name.removesuffix(_LOCK)}*") if path != lock]
    try:
        for path in (*removed, lock):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    except OSError:  # another user's, or gone
        return []
    return removed
