# SPDX-License-Identifier: MIT
"""Triton and what belongs to it, kept answering until a signal stops it."""

from __future__ import annotations

import signal
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from functools import partial
from types import FrameType

from rfm.launch import cleanup
from rfm.launch.ending import end, ending_with_parent, stop_signals_to
from rfm.launch.installation import ServerStartError
from rfm.launch.process import POLL_S, Config, TritonServer
from rfm.supervise.status import Status, StatusServer
from rfm.supervise.watch import TRITON, TritonWatch, parts_of

GATEWAY = "gateway"
STEADY_S = 60.0  # whatever has run for so long is no part of a crash loop
MOST = 5  # restarts in a row
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 10.0


class CrashLoopError(ServerStartError):
    """A process ended so often that it is not started again."""


class BackOff:
    """The pauses before one thing is started again: none at first, longer ones where the starts follow closely."""

    def __init__(self, what: str, steady_s: float = STEADY_S) -> None:
        self._what, self._steady_s = what, steady_s
        self._row = 0
        self._running_since_s: float | None = None  # None: it has ended

    def started(self) -> None:
        """Records a start, from which the next pause is computed."""
        self._running_since_s = time.monotonic()

    def pause_s(self, reason: str) -> float:
        """Seconds to wait before the next start, after an exit or a failed start.

        Raises CrashLoopError when it is one.
        """
        if self._running_since_s is not None and time.monotonic() - self._running_since_s >= self._steady_s:
            self._row = 0
        self._running_since_s = None  # a start that failed does not count as running, however long it took
        self._row += 1
        if self._row > MOST:
            got = f"{self._row} ends, each within {self._steady_s:g} s of a start; the last: {reason}"
            raise CrashLoopError(f"{self._what}: expected to run, got {got}")
        return 0.0 if self._row == 1 else min(FIRST_PAUSE_S * 2.0 ** (self._row - 2), LONGEST_PAUSE_S)


class GatewayProcess:
    """Runs the command line from ``start`` to ``stop``; ``look``, called often, starts it again when it has ended."""

    def __init__(self, command: Sequence[str]) -> None:
        self._command = command
        self._back_off = BackOff(GATEWAY)
        self._process: subprocess.Popen[bytes] | None = None
        self._due_s: float | None = None

    def start(self) -> None:
        """Starts the gateway as a child process."""
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, preexec_fn=ending_with_parent(), start_new_session=True
        )
        self._back_off.started()

    def look(self) -> str | None:
        """Starts the gateway again if it has ended, and gives why; None: it was not started. Raises CrashLoopError."""
        if self._process is None or self._process.poll() is None:
            return None
        why = f"exit status {self._process.returncode}"
        if self._due_s is None:
            self._due_s = time.monotonic() + self._back_off.pause_s(why)
        if time.monotonic() < self._due_s:
            return None
        self._due_s = None
        self.start()
        return why

    def stop(self) -> None:
        """Lets the gateway answer the requests in flight, and ends it; by force after KILL_AFTER_S."""
        if self._process is not None:
            end(self._process)


class Supervisor:
    """Serves until a signal to stop comes. Run it in the main thread.

    gateway: command line of a gateway that runs beside the server; None: there is none
    status_port: of the status (``status``), on the server's host; None: there is none
    canary_s, hang_s, triton_silent_s: as TritonWatch has them
    say: takes what happened, a line each
    """

    def __init__(
        self,
        server: TritonServer,
        *,
        gateway: Sequence[str] | None = None,
        status_port: int | None = None,
        canary_s: float,
        hang_s: float,
        triton_silent_s: float,
        say: Callable[[str], None],
    ) -> None:
        self._server = server
        self._gateway = None if gateway is None else GatewayProcess(gateway)
        self._status_port = status_port
        self._say = say
        self._status = Status()
        self._new_watch = partial(
            TritonWatch, server, self._status, canary_s=canary_s, hang_s=hang_s, silent_s=triton_silent_s
        )
        self._is_to_stop = threading.Event()
        self._new_back_off = partial(BackOff, "tritonserver", STEADY_S + hang_s)
        self._back_off = self._new_back_off()
        self._watch: TritonWatch | None = None  # None: Triton is started, or has ended
        self._served: dict[str, Config] | None = None  # last; None: nothing yet
        self._left_out: dict[str, str] = {}  # models that kept ending Triton, and how

    def run(self) -> int:
        """Gives Triton's exit status. Raises ServerStartError for what does not start, or ends again and again."""
        for path in cleanup.clear():
            self._say(f"removed {path}, which a server left that was killed")
        self._status.record(dict.fromkeys(self._server.models, "it is loaded"))
        for what in (TRITON, *self._server.models, *(() if self._gateway is None else (GATEWAY,))):
            self._status.restarts.labels(what)  # 0, so that already the first is an increase
        port, host = self._status_port, self._server.endpoints.host
        with (
            stop_signals_to(self._stop),
            nullcontext() if port is None else closing(StatusServer(host, port, self._status)),
        ):
            return self._serve()

    def _stop(self, number: int, _frame: FrameType | None) -> None:
        self._is_to_stop.set()
        if self._watch is None:  # it loads, and would not look
            self._server.signal(signal.SIGTERM if number == signal.SIGHUP else number)

    def _serve(self) -> int:
        try:
            self._start()
            if self._gateway is not None and self._watch is not None:
                self._gateway.start()
            while not self._is_to_stop.wait(POLL_S):
                self._look()
        except ServerStartError:
            if not self._is_to_stop.is_set():  # else it ended as it should
                raise
        finally:
            self._status.record_down("it is stopping")
            if self._gateway is not None:  # the gateway answers its requests in flight before the server stops
                self._gateway.stop()
            self._close_watch()
            status = self._server.stop()
        return status

    def _start(self) -> None:
        """Starts Triton, and looks after it from now on. Raises ServerStartError.

        What was served before is served again, whatever was exported since.
        """
        self._server.start_ready(self._served)
        if self._is_to_stop.is_set():
            return
        if self._served is None:
            ends = self._server.endpoints
            urls = f"{ends.grpc_url}, {ends.http_url}, metrics at {ends.metrics_url}"
            self._say(f"ready: {', '.join(self._server.models)} at {urls}")
        self._back_off.started()
        self._watch = self._new_watch(served=self._served or {})

    def _look(self) -> None:
        """Starts again what has ended. Raises CrashLoopError."""
        if self._watch is None:
            return
        if self._server.exit_status is not None:
            self._start_again(TRITON, f"exit status {self._server.exit_status}")
        elif self._watch.fault is not None:
            self._start_again(*self._watch.fault)
        if self._gateway is not None and (why := self._gateway.look()):
            self._count(GATEWAY, why)
        if self._watch is not None and self._watch.reasons:
            reasons = self._watch.reasons
            self._left_out = {model: why for model, why in self._left_out.items() if model not in reasons}
            self._status.record({**self._left_out, **reasons})

    def _start_again(self, what: str, why: str) -> None:
        """Returns when Triton is ready, or a signal has come. Raises CrashLoopError.

        what: the model that is to blame, or TRITON
        """
        while not self._is_to_stop.is_set():
            self._count(what, why)
            self._close_watch()
            self._status.record_down(f"tritonserver is started again: {what}: {why}")
            self._server.kill()
            self._server.stop()  # what is left of it
            try:
                pause_s = self._back_off.pause_s(f"{what}: {why}")
            except CrashLoopError:
                if not self._leaves_out(what, why):
                    raise
                pause_s = 0.0
            if self._is_to_stop.wait(pause_s):
                return
            try:
                self._start()
                return
            except ServerStartError as error:
                what, why = error.model or what, str(error)  # Triton 2.51 itself ends with a process that loads

    def _leaves_out(self, what: str, why: str) -> bool:
        """True if others are served from now on, without the model ``what`` and what is made of it."""
        served = self._served or {}
        left_out = [what, *(name for name, config in served.items() if what in parts_of(config))]
        others = {name: config for name, config in served.items() if name not in left_out}
        if what not in served or not others:
            return False
        self._say(f"{what} is left out, since it kept ending: {why}")
        reason = f"it is left out, since {what} kept ending: {why}; `rfm models load` takes it in"
        self._left_out |= dict.fromkeys(left_out, reason)
        self._served = others
        self._back_off = self._new_back_off()
        return True

    def _count(self, what: str, why: str) -> None:
        self._status.restarts.labels(what).inc()
        restarted = GATEWAY if what == GATEWAY else TRITON
        self._say(f"{restarted} is started again: {why if what == restarted else f'{what}: {why}'}")

    def _close_watch(self) -> None:
        if self._watch is not None:
            self._served = self._watch.served or self._served
            self._watch.close()
            self._watch = None
