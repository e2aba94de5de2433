# SPDX-License-Identifier: MIT
"""Remove the shared memory that ``rfm serve`` leaves behind when SIGKILL ends it."""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
from pathlib import Path

from rfm.launch.installation import ServerStartError

SHARED_MEMORY = Path("/dev/shm")
# Beginning of the names of the Python backend's regions. Newer Tritons let no client map a region with this name.
REGION_PREFIX = "triton_python_backend_shm_region_rfm"
NEEDS_ROOM = "free some (a container has more of /dev/shm with --shm-size)"

_LOCK = "lock"


class Claim:
    """A server's shared memory: the Python backend's regions, and a folder for ``Installation``.

    This process and its children hold a lock through ``lock_file``, which ends with the last of them. A process id
    would prove nothing, because containers with process ids of their own may share the memory.
    """

    def __init__(self) -> None:
        """Create the lock and the folder. Raises ServerStartError if they cannot be written."""
        name = f"{os.getpid()}_{secrets.token_hex(4)}"
        self.region_prefix = f"{REGION_PREFIX}_{name}_"
        self.backends = SHARED_MEMORY / f"{self.region_prefix}backends"
        self._lock = SHARED_MEMORY / f"{self.region_prefix}{_LOCK}"
        new_lock = SHARED_MEMORY / f"rfm-new-{name}"
        try:
            self.lock_file = os.open(new_lock, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600)
            fcntl.flock(self.lock_file, fcntl.LOCK_EX)
            new_lock.rename(self._lock)  # renamed once locked, so that ``clear`` never finds it unlocked
            self.backends.mkdir(0o700)
        except OSError as error:
            raise ServerStartError.at(
                error.filename, "room for a server's files", error.strerror, NEEDS_ROOM
            ) from error

    def release(self) -> None:
        """Remove the regions, the folder and the lock."""
        _remove(self._lock)
        os.close(self.lock_file)


def clear() -> list[Path]:
    """Remove the shared memory of servers without a living process. Return the removed paths."""
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
    """Remove the paths that a lock protects, and return them. The lock goes last, so that a later call can finish."""
    removed = [path for path in lock.parent.glob(f"{lock.name.removesuffix(_LOCK)}*") if path != lock]
    try:
        for path in (*removed, lock):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    except OSError:  # another user's, or gone
        return []
    return removed
