# SPDX-License-Identifier: MIT
"""What ``rfm serve`` runs: Triton, and perhaps a gateway, kept answering until a signal stops it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from functools import partial
from types import FrameType

from rfm.launch import cleanup
from rfm.launch.ending import stop_signals_to
from rfm.launch.installation import ServerStartError
from rfm.launch.process import (
    MAX_REPEATS,
    PATIENT_S,
    POLL_S,
    STALLED_S,
    SpoiltStartError,
    StalledStartError,
    TritonServer,
)
from rfm.supervise.back_off import BackOff
from rfm.supervise.gateway_process import GatewayProcess
from rfm.supervise.served_models import ServedModels
from rfm.supervise.status import Status, StatusServer
from rfm.supervise.triton_watch import Config, names_the_same_versions


class Supervisor:
    """Serves until a signal to stop comes. Run it in the main thread.

    gateway: command line of a gateway that runs beside the server; None: there is none
    status_port: of the status (``status``), on the server's host; None: there is none
    canary_s: how often each model is probed
    hang_s: how long a model may take to get one forward pass further, or answer nobody, before it counts as hung
    triton_silent_s: how long Triton may give no answer to several looks in a row before it is killed
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
        self._triton_silent_s = triton_silent_s
        self._say = say
        self._status = Status()
        self._new_models = partial(
            ServedModels, server, self._status, say, canary_s=canary_s, hang_s=hang_s, triton_silent_s=triton_silent_s
        )
        self._is_to_stop = threading.Event()
        self._back_off = BackOff("tritonserver")
        self._stalled_s = STALLED_S
        self._models: ServedModels | None = None  # None: it is started, or has ended
        self._configs: dict[str, Config] | None = None  # the configurations served last; None: those in the files

    def run(self) -> int:
        """Gives Triton's exit status. Raises ServerStartError for what does not start, or ends again and again."""
        for path in cleanup.clear():
            self._say(f"removed {path}, which a server left that was killed")
        self._status.record(dict.fromkeys(self._server.models, "it is loaded"))
        for what in ("triton", *self._server.models, *(() if self._gateway is None else ("gateway",))):
            self._status.restarts.labels(what)  # 0, so that already the first is an increase
        port, host = self._status_port, self._server.endpoints.host
        with (
            stop_signals_to(self._stop),
            nullcontext() if port is None else closing(StatusServer(host, port, self._status)),
        ):
            return self._serve()

    def _stop(self, number: int, _frame: FrameType | None) -> None:
        self._is_to_stop.set()
        if self._models is None:  # it loads, and would not look
            self._server.signal(signal.SIGTERM if number == signal.SIGHUP else number)

    def _serve(self) -> int:
        try:
            self._start_first()
            if self._gateway is not None and self._models is not None:
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
            self._close_models()
            status = self._server.stop()
        return status

    def _start_first(self) -> None:
        for _ in range(MAX_REPEATS):
            try:
                self._start()
                return
            except SpoiltStartError as error:
                self._count("triton", str(error))
                self._server.stop()
        self._stalled_s = PATIENT_S
        self._start()

    def _start(self) -> None:
        """Starts Triton, and looks after its models from now on. Raises ServerStartError.

        What was served before is served again, whatever was exported since. A model that cannot be loaded then does
        not keep the others from being served.
        """
        self._server.start(self._restored())
        if self._is_to_stop.is_set():  # before there was a process to pass it to
            return
        try:
            self._server.wait_ready(self._stalled_s)
        except StalledStartError:
            self._stalled_s = PATIENT_S  # if models of other backends are slow, they have their time from now on
            raise
        ends = self._server.endpoints
        urls = f"{ends.grpc_url}, {ends.http_url}, metrics at {ends.metrics_url}"
        if self._configs is None:
            self._say(f"ready: {', '.join(self._server.models)} at {urls}")
        self._back_off.started()
        self._models = self._new_models(restored=self._configs or {})

    def _restored(self) -> list[str] | None:
        """The models that Triton loads by itself, before it answers anybody; None: all, for it never served any.

        It can do so by their files alone. Where one of those names other versions by now, all are loaded afterwards.
        """
        if self._configs is None:
            return None
        is_so = all(names_the_same_versions(self._server.repository, *each) for each in self._configs.items())
        return list(self._configs) if is_so else []

    def _look(self) -> None:
        """Starts again whatever has ended. Raises CrashLoopError."""
        if self._models is not None and self._models.is_silent:
            self._server.kill()
            self._start_again(f"no answer for {self._triton_silent_s:g} s")
        elif self._models is not None and (why := self._models.owing) is not None:
            self._server.remember_the_dead()
            self._server.kill()
            self._start_again(why)
        elif self._server.exit_status is not None:
            self._start_again(f"exit status {self._server.exit_status}")
        if self._gateway is not None and (why := self._gateway.look()):
            self._count("gateway", why)
        if self._models is not None:
            for model, why in self._models.look():
                self._count(model, why)

    def _start_again(self, why: str) -> None:
        """Returns when Triton is ready, or a signal has come. Raises CrashLoopError."""
        while not self._is_to_stop.is_set():
            self._count("triton", why)
            self._close_models()
            self._status.record_down(f"tritonserver is started again, after {why}")
            self._server.stop()  # what is left of it
            if self._is_to_stop.wait(self._back_off.pause_s(why)):
                return
            try:
                self._start()
                return
            except ServerStartError as error:
                why = str(error)

    def _count(self, what: str, why: str) -> None:
        self._status.restarts.labels(what).inc()
        self._say(f"{what} is started again: {why}")

    def _close_models(self) -> None:
        if self._models is not None:
            if self._models.configs is not None:
                self._configs = self._models.configs
            self._models.close()
            self._models = None
