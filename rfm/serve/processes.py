# SPDX-License-Identifier: MIT
"""End processes, find dead and stopped model processes, and remove the shared memory of killed servers."""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import psutil

from rfm.serve.installation import ServerStartError

KILL_AFTER_S = 20.0  # for requests in flight
REAP_S, POLL_S = 5.0, 0.02  # a driver or a disk may hold a killed process for longer
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_SIGNALS = {each.value: each.name for each in signal.Signals}
_SENTINEL = ("/bin/sh", "-c", "trap '' HUP INT TERM; read _; kill -KILL 0")  # 0: its process group


@contextmanager
def stop_signals_to(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Context manager in which ``handler`` receives SIGINT, SIGTERM and SIGHUP. For the main thread."""
    previous = {number: signal.signal(number, handler) for number in _STOP_SIGNALS}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


class ProcessGroup:
    """A process and everything that it starts. They end with this process, even if SIGKILL ends it.

    A shell leads the group. Only this process can write to the pipe that the shell reads. When the pipe closes, the
    shell kills the group. No other group can take the id until ``end``.
    """

    def __init__(self, command: Sequence[str | os.PathLike[str]], **options: Any) -> None:
        """Start the process. Raises OSError."""
        self._sentinel = subprocess.Popen(_SENTINEL, stdin=subprocess.PIPE, preexec_fn=os.setpgrp)
        self.id = self._sentinel.pid
        try:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                preexec_fn=partial(os.setpgid, 0, self.id),  # a Ctrl-C reaches this process alone, which passes it on
                restore_signals=False,  # SIGPIPE stays ignored: a log that nobody reads ends no process
                **options,
            )
        except BaseException:
            self._sentinel.communicate()
            raise

    def kill(self) -> None:
        """Kill every process in the group."""
        if self._sentinel.returncode is None:  # else another group may have the id
            os.killpg(self.id, signal.SIGKILL)

    def end(self, within_s: float = KILL_AFTER_S) -> None:
        """End the process gracefully, by force after ``within_s``, then the rest of the group."""
        if self._sentinel.returncode is not None:  # all have ended
            return
        self.process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(within_s)
        self.kill()
        self.process.wait()
        ends_s = time.monotonic() + REAP_S
        with suppress(ChildProcessError):
            while time.monotonic() < ends_s:  # orphans, too: the first process of a container inherits them
                if os.waitpid(-self.id, os.WNOHANG) == (0, 0):
                    time.sleep(POLL_S)
        self._sentinel.communicate()  # closes the pipe, and records that the shell has ended


def how_it_ended(status: int) -> str:
    """Return an exit status in words. status: as from Popen, negative after a signal"""
    return f"killed by {_SIGNALS.get(-status, -status)}" if status < 0 else f"exit status {status}"


UNKNOWN = ""  # model name for a process that died before the first look
# Triton ends a failed load within about 1 s, unless the process died before its handshake. On a busy machine a process
# that a load replaced was a zombie for more than 3 s.
LOADING_DEAD_S = 10.0
_PROGRAM = "triton_python_backend_stub"
_STATES = {psutil.STATUS_ZOMBIE: "dead", psutil.STATUS_STOPPED: "stopped"}


class ModelProcesses:
    """Triton's model processes, one per instance, from /proc.

    Triton notices that a served model's process has died only at the next request, and keeps a zombie until then. It
    never notices if a loading model's process dies before its handshake. A process that Triton replaces may be a zombie
    for seconds.
    """

    def __init__(self, triton_pid: int) -> None:
        self._triton_pid = triton_pid
        self._models: dict[int, str] = {}  # by process id; a zombie has no command line
        self._since_s: dict[int, float] = {}  # when a process was first seen dead or stopped

    def fault(self, wanted: Mapping[str, int] | None = None, *, is_settled: bool = False) -> tuple[str, str] | None:
        """Return a model whose process is dead or stopped, and how that came about.

        wanted: process count by model; a dead process counts as replaced while this many live
        is_settled: no model loads or unloads: a fault counts at the second look, otherwise after LOADING_DEAD_S
        """
        states, now_s = self._states(), time.monotonic()
        living = Counter(self._models[pid] for pid, state in states.items() if state not in _STATES)
        enough = {model for model, number in (wanted or {}).items() if living[model] >= number}
        replaced = [
            pid for pid, state in states.items() if state == psutil.STATUS_ZOMBIE and self._models[pid] in enough
        ]
        ill = [pid for pid in states.keys() - replaced if states[pid] in _STATES]
        before, self._since_s = self._since_s, {pid: self._since_s.get(pid, now_s) for pid in ill}
        for pid in sorted(before.keys() & self._since_s.keys()):
            if is_settled or now_s - before[pid] >= LOADING_DEAD_S:
                how = _how_it_died(pid) if states[pid] == psutil.STATUS_ZOMBIE else ""
                return self._models[pid], f"its process {pid} is {_STATES[states[pid]]}{how}"
        return None

    @property
    def has_found_any(self) -> bool:
        """True if ``fault`` has seen a model process."""
        return bool(self._models)

    def _states(self) -> dict[int, str]:
        """Return the state of each model process, and record its model."""
        states: dict[int, str] = {}
        for pid in children_of(self._triton_pid):
            with suppress(psutil.NoSuchProcess):  # the process has ended
                process = psutil.Process(pid)
                state = process.status()
                words = [] if state == psutil.STATUS_ZOMBIE else process.cmdline()
                if len(words) > 1 and words[0].endswith(_PROGRAM):  # then .../MODEL/VERSION/model.py
                    self._models[pid] = Path(words[1]).parent.parent.name
                elif state == psutil.STATUS_ZOMBIE:  # also if it died before it ran the program
                    self._models.setdefault(pid, UNKNOWN)
                if pid in self._models:
                    states[pid] = state
        self._models = {pid: model for pid, model in self._models.items() if pid in states}
        return states


def _how_it_died(pid: int) -> str:
    """Return how a zombie ended, in words; empty after exit status 0, and if the kernel hides it from this user."""
    try:
        status = int(Path(f"/proc/{pid}/stat").read_text().split()[-1])  # as from waitpid
    except (OSError, ValueError):
        return ""
    return f" ({how_it_ended(os.waitstatus_to_exitcode(status))})" if status else ""


def children_of(pid: int) -> Iterator[int]:
    """Yield the ids of a process's children, including zombies.

    Reads the kernel's child lists if they exist, because a machine may have thousands of processes.
    """
    lists = list(Path(f"/proc/{pid}/task").glob("*/children"))
    for file in lists:
        with suppress(FileNotFoundError, ProcessLookupError):  # the thread has ended
            yield from map(int, file.read_text().split())
    if not lists:
        with suppress(psutil.NoSuchProcess):
            yield from (child.pid for child in psutil.Process(pid).children())


SHARED_MEMORY = Path("/dev/shm")
# Prefix of the names of the Python backend's regions. Newer Tritons let no client map a region with this name.
REGION_PREFIX = "triton_python_backend_shm_region_rfm"
NEEDS_ROOM = "free some (a container has more of /dev/shm with --shm-size)"
_LOCK = "lock"


class Claim:
    """A server's shared memory: the Python backend's regions, and a folder with links for Triton.

    Triton reads the models through the link ``models``: a path without spaces, which the Python backend passes to a
    shell unquoted. ``show`` changes where it leads.

    This process and its children hold a lock through ``lock_file`` until the last of them ends. A process id would
    prove nothing: containers with their own process ids may share the memory.
    """

    def __init__(self) -> None:
        """Create the lock and the folder. Raises ServerStartError if they cannot be written."""
        name = f"{os.getpid()}_{secrets.token_hex(4)}"
        self.region_prefix = f"{REGION_PREFIX}_{name}_"
        self.folder = SHARED_MEMORY / f"{self.region_prefix}links"
        self.models = self.folder / "models"
        self._lock = SHARED_MEMORY / f"{self.region_prefix}{_LOCK}"
        new_lock = SHARED_MEMORY / f"rfm-new-{name}"
        try:
            self.lock_file = os.open(new_lock, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600)
            fcntl.flock(self.lock_file, fcntl.LOCK_EX)
            new_lock.rename(self._lock)  # renamed once locked, so that ``clear_shared_memory`` never finds it unlocked
            self.folder.mkdir(0o700)
        except OSError as error:
            raise ServerStartError.at(
                error.filename, "room for a server's files", error.strerror, NEEDS_ROOM
            ) from error

    def show(self, repository: Path) -> None:
        """Let Triton read the models in this folder from now on. Raises OSError."""
        if self.models.is_symlink() and self.models.readlink() == repository.absolute():
            return
        new = self.folder / "new"
        new.unlink(missing_ok=True)
        new.symlink_to(repository.absolute())
        new.rename(self.models)

    def release(self) -> None:
        """Remove the regions, the folder and the lock."""
        _remove(self._lock)
        os.close(self.lock_file)


def clear_shared_memory() -> list[Path]:
    """Remove shared memory that no living server holds. Return the removed paths."""
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
