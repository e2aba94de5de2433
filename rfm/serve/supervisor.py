# SPDX-License-Identifier: MIT
"""Supervisor: runs Triton and the gateway, and restarts them after a fault, until a signal stops it."""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from dataclasses import KW_ONLY, dataclass
from types import FrameType

from rfm.serve.installation import ServerStartError
from rfm.serve.probe import NO_ANSWER, Http
from rfm.serve.processes import ProcessGroup, clear_shared_memory, how_it_ended, stop_signals_to
from rfm.serve.repository import Config, versions_in, versions_in_file
from rfm.serve.status import Status, StatusServer
from rfm.serve.triton_server import POLL_S, SpoiltStartError, TritonServer
from rfm.serve.watch import TRITON, TritonWatch

GATEWAY = "gateway"
STEADY_S = 60.0  # a process that ran longer is not in a crash loop
MOST = 5  # restarts in a row; a call ends a process twice at most
ASK_S = 1.0  # between requests to the gateway
TRIES = 2  # unanswered requests in a row; a single one may mean that the machine stood still
STILL_S = 2.0  # longest pause of all processes (docker pause) after which Triton may go on
GATEWAY_PAUSE_S = 5.0  # between gateway starts
logger = logging.getLogger(__name__)


class CrashLoopError(ServerStartError):
    """A process had too many faults in a row to restart it."""


class FaultCount:
    """Counts Triton's consecutive faults. A fault after a run of ``steady_s`` starts a new count."""

    def __init__(self, steady_s: float = STEADY_S) -> None:
        self._steady_s = steady_s
        self._num_faults = 0  # in a row
        self._running_since_s: float | None = None  # None: not running

    def started(self) -> None:
        """Record a successful start."""
        self._running_since_s = time.monotonic()

    def failed(self, reason: str) -> None:
        """Record a fault or a failed start. Raises CrashLoopError after more than MOST in a row."""
        if self._running_since_s is not None and time.monotonic() - self._running_since_s >= self._steady_s:
            self._num_faults = 0
        self._running_since_s = None  # a failed start does not count as running
        self._num_faults += 1
        if self._num_faults > MOST:
            got = f"{self._num_faults} faults in a row; the last: {reason}"
            raise CrashLoopError(f"{TRITON}: expected to run, got {got}")


class GatewayProcess:
    """The gateway as a child process. Call ``look`` often: it restarts an ended gateway without limit.

    A thread kills a gateway that listens but is silent.

    command: the gateway's command line
    address: the gateway's host and port
    silent_s: a gateway without an answer for this long counts as silent
    """

    def __init__(self, command: Sequence[str], address: tuple[str, int], silent_s: float) -> None:
        self.command, self._http, self._silent_s = command, Http(*address), silent_s
        self._group: ProcessGroup | None = None
        self._started_s = 0.0
        self._fault: str | None = None

    def start(self) -> None:
        """Start the gateway as a child process."""
        self._started_s = time.monotonic()
        self._group = ProcessGroup(self.command)
        self._fault = None
        threading.Thread(target=self._listen, args=(self._group,), name="rfm-gateway", daemon=True).start()

    def _listen(self, group: ProcessGroup) -> None:
        num_missed = 0
        while group.process.poll() is None:
            try:
                self._http.request("HEAD", "/", self._silent_s / TRIES)
                num_missed = 0
            except TimeoutError:
                num_missed += 1
            except NO_ANSWER:  # it does not listen yet, has ended, or requires TLS, which is a sign of life
                num_missed = 0
            if num_missed == TRIES:
                self._fault = f"no answer for {self._silent_s:g} s"
                group.kill()
            time.sleep(ASK_S)

    def look(self) -> str | None:
        """Restart an ended gateway, at least GATEWAY_PAUSE_S after its start. Return why it ended; None: no restart."""
        if self._group is None or (status := self._group.process.poll()) is None:
            return None
        if time.monotonic() - self._started_s < GATEWAY_PAUSE_S:
            return None
        why = self._fault or how_it_ended(status)
        self._group.end()
        self.start()
        return why

    def stop(self) -> None:
        """End the gateway after its requests in flight, by force after KILL_AFTER_S."""
        if self._group is not None:
            self._group.end()


@dataclass(eq=False)
class Supervisor:
    """Serves until a stop signal. For the main thread.

    gateway: a gateway beside the server; None: no gateway
    status_port: port for the status server, on Triton's host; None: no status server
    probe_s, triton_silent_s: see TritonWatch
    tell_ready: called once when all models are ready for the first time; None: log a line instead
    """

    server: TritonServer
    _: KW_ONLY
    probe_s: float
    triton_silent_s: float
    gateway: GatewayProcess | None = None
    status_port: int | None = None
    tell_ready: Callable[[], None] | None = None

    def __post_init__(self) -> None:
        self._status = Status(self._versions)
        self._is_to_stop = threading.Event()
        self._faults = FaultCount(STEADY_S + self.server.hang_s)
        self._watch: TritonWatch | None = None  # None: Triton is starting, or has ended
        self._served: dict[str, Config] | None = None  # configurations before the restart; None: first start
        self._start_s = 0.0  # how long the last start took

    def run(self) -> None:
        """Serve until a stop signal. Raises ServerStartError for a failed start or a crash loop."""
        for path in clear_shared_memory():
            logger.info("removed %s, left by a killed server", path)
        self._status.record(dict.fromkeys(self.server.models, "it is loading"))
        for what in (TRITON,) if self.gateway is None else (TRITON, GATEWAY):
            self._status.restarts.labels(what)  # begins at 0, as those of the models
        port, host = self.status_port, self.server.endpoints.host
        with (
            stop_signals_to(self._stop),
            nullcontext() if port is None else closing(StatusServer(host, port, self._status)),
        ):
            self._serve()

    def _versions(self, model: str) -> dict[str, list[int] | None]:
        """Return a model's versions for ``/ready``: those that are served, and those that its file names."""
        watch = self._watch
        served = {} if watch is None else watch.served
        return {
            "versions": versions_in(served[model]) if model in served else [],
            "versions_in_file": versions_in_file(self.server.repository, model),
        }

    def _stop(self, number: int, _frame: FrameType | None) -> None:
        self._is_to_stop.set()
        if self._watch is None:  # Triton is loading
            self.server.signal(signal.SIGTERM if number == signal.SIGHUP else number)

    def _serve(self) -> None:
        try:
            self._start()
            if self.gateway is not None and self._watch is not None:
                self.gateway.start()
            began_s = time.monotonic()
            while not self._is_to_stop.wait(POLL_S):
                self._look(time.monotonic() - began_s)
                began_s = time.monotonic()
        except ServerStartError:
            if not self._is_to_stop.is_set():
                raise
        finally:
            if self._is_to_stop.is_set():
                logger.info("stopping, after the requests in flight")
            self._status.record_down("it is stopping")
            if self.gateway is not None:  # before the server, so that requests in flight get answers
                self.gateway.stop()
            self._close_watch()
            self.server.stop()

    def _start(self) -> None:
        """Start Triton with the versions served before (at first, the repository's). Raises ServerStartError."""
        began_s = time.monotonic()
        self.server.start_ready(self._served)
        if self._is_to_stop.is_set():
            return
        self._start_s = time.monotonic() - began_s
        self._status.start_s.set(self._start_s)
        if self._served is None:
            (self.tell_ready or self._log_ready)()
        self._faults.started()
        self._watch = TritonWatch(
            self.server, probe_s=self.probe_s, silent_s=self.triton_silent_s, served=self._served or {}
        )

    def _log_ready(self) -> None:
        ends = self.server.endpoints
        urls = f"{ends.grpc_url}, {ends.http_url}, metrics at {ends.metrics_url}"
        logger.info("ready after %.0f s: %s at %s", self._start_s, ", ".join(self.server.models), urls)

    def _look(self, waited_s: float) -> None:
        """Restart Triton or the gateway if it ended or has a fault. Raises CrashLoopError.

        waited_s: since the last look. After a pause, the model processes of Triton 2.51 end at the locks that they
            share with it, and a request may get another's answer; so Triton is killed at once
        """
        if self._watch is None:
            return
        if waited_s > STILL_S:
            self._start_again(TRITON, f"all processes stood still for {waited_s:.0f} s", counts=False)
        elif self.server.exit_status is not None:
            self._start_again(TRITON, how_it_ended(self.server.exit_status))
        elif self._watch.fault is not None:
            self._start_again(*self._watch.fault, counts=not self._watch.is_of_load)
        if self.gateway is not None and (why := self.gateway.look()):
            self._status.restarts.labels(GATEWAY).inc()
            logger.warning("%s is started again: %s", GATEWAY, why)
        if self._watch is not None and self._watch.reasons:
            self._status.record(self._watch.reasons)

    def _start_again(self, what: str, why: str, *, counts: bool = True) -> None:
        """Restart Triton; return when it is ready, or after a stop signal. Raises CrashLoopError.

        what: the model at fault, or TRITON
        counts: False: the fault is not part of a crash loop
        """
        began_s = time.monotonic()
        while not self._is_to_stop.is_set():
            self._close_watch()
            reason = why if what == TRITON else f"{what}: {why}"
            again = f"{TRITON} is started again: {reason}; all models load, which took {self._start_s:.0f} s last time"
            self._status.record_down(f"{TRITON} is started again", again.removeprefix(f"{TRITON} is started again"))
            self.server.kill()
            self.server.stop()
            if counts:
                self._faults.failed(reason)
            counts = True
            self._status.restarts.labels(what).inc()
            logger.warning("%s", again)
            try:
                self._start()
                if self._watch is not None:
                    logger.info("ready again after %.1f s", time.monotonic() - began_s)
                return
            except ServerStartError as error:
                # The model from before is to blame if Triton itself crashes, but not if something outside kills Triton.
                was_killed = self.server.exit_status == -signal.SIGKILL and not isinstance(error, SpoiltStartError)
                what, why = error.model or (TRITON if was_killed else what), str(error)

    def _close_watch(self) -> None:
        if self._watch is not None:
            self._served = self._watch.served or self._served
            self._watch.close()
            self._watch = None
