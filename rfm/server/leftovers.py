# SPDX-License-Identifier: MIT
"""What ``rfm serve`` would leave behind if it is killed with -9: processes, shared memory, folders."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

from rfm.server.stubs import SHARED_MEMORY, is_alive

BACKENDS_PREFIX = "rfm-backends-"
# Newer Tritons let no client map a region of this name, which is that of the Python backend's own.
REGION_PREFIX = "triton_python_backend_shm_region_rfm"

_PR_SET_PDEATHSIG = 1
_WATCH_INTERVAL_S = 1.0
_OWNED = re.compile(
    r"(?:triton_python_backend_shm_region_)?rfm[_-](?:backends-)?(?P<pid>\d+)[_-](?P<namespace>[0-9a-f]+)[_-]"
)

_prctl = ctypes.CDLL(None).prctl


def owned(prefix: str, separator: str) -> str:
    """The beginning of a name that tells whose it is: this process', in its namespace of process ids."""
    return separator.join((prefix, str(os.getpid()), _namespace(), ""))


def ending_with_parent() -> Callable[[], None]:
    """For ``preexec_fn``: the process is killed when the thread that starts it ends, however that ends."""
    parent = os.getpid()

    def bind() -> None:
        _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it has ended already
            os._exit(1)

    return bind


def end_with_triton() -> None:
    """For a model process: it ends when Triton has, however that ended, and whatever it waits for."""
    triton = os.getppid()

    def watch() -> None:
        while os.getppid() == triton:
            time.sleep(_WATCH_INTERVAL_S)
        os._exit(1)

    threading.Thread(target=watch, name="rfm-end-with-triton", daemon=True).start()


def clear() -> list[Path]:
    """Removes what servers of this machine left that live no more, and tells what it was."""
    removed = []
    for path in (*SHARED_MEMORY.glob(f"{REGION_PREFIX}_*"), *Path(tempfile.gettempdir()).glob(f"{BACKENDS_PREFIX}*")):
        name = _OWNED.match(path.name)
        # A process id of another namespace, of a container say, tells nothing here.
        if name is None or name["namespace"] != _namespace() or is_alive(int(name["pid"])):
            continue
        try:
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
        except OSError:  # another user's, or gone
            continue
        removed.append(path)
    return removed


def _namespace() -> str:
    return f"{os.stat('/proc/self/ns/pid').st_ino:x}"  # noqa: PTH116  Path.stat is the same
