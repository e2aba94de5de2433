# SPDX-License-Identifier: MIT
"""The status port of ``rfm serve``: whether it lives, whether it is ready, and what it had to heal."""

from __future__ import annotations

import json
import socket
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from rfm.launch.installation import ServerStartError
from rfm_client.contract.listening import check_free

NO_REASON = ""  # the reason why a model is not ready, of one that is
REQUEST_S = 5.0  # from its connection to its answer
MOST_CONNECTIONS = 16  # one more takes the place of the oldest

_BUCKETS_S = tuple(digit * 10.0**power for power in range(-3, 2) for digit in (1, 2, 5))


class Status:
    """What is known of the models. The supervisor calls ``record`` and its kin, the status port the rest."""

    def __init__(self) -> None:
        self._reasons: Mapping[str, str] = {}
        self._probed: set[str] = set()  # models that have a probe
        self._registry = CollectorRegistry()
        labelled: dict[str, Any] = {"labelnames": ["model"], "registry": self._registry}
        self._ready = Gauge("rfm_serve_ready", "1: the model is ready.", **labelled)
        self._reason = Gauge(
            "rfm_serve_not_ready", "1: the model is not ready, and why.", ["model", "reason"], registry=self._registry
        )
        self._probe_ok = Gauge("rfm_serve_canary_ok", "1: the last health probe was answered.", **labelled)
        self.probe_seconds = Histogram(
            "rfm_serve_canary_seconds",
            "From a health probe to its answer.",
            ["model"],
            buckets=_BUCKETS_S,
            registry=self._registry,
        )
        self.restarts = Counter(
            "rfm_serve_restarts",
            "What was started again because it was dead or hung: triton, gateway, or a model.",
            ["what"],
            registry=self._registry,
        )
        self.poison_refused = Counter(
            "rfm_serve_poison_refused",
            "Requests that were refused because they had ended the model's process.",
            registry=self._registry,
        )

    def record(self, reasons: Mapping[str, str]) -> None:
        """Records by model why it is not ready; NO_REASON for one that is. There are no other models."""
        gone, before, self._reasons = self._reasons.keys() - reasons.keys(), self._reasons, dict(reasons)
        for model, reason in before.items():
            if reason not in (NO_REASON, reasons.get(model)):
                self._reason.remove(model, reason)
        for model, reason in reasons.items():
            self._ready.labels(model).set(reason == NO_REASON)
            if reason != NO_REASON:
                self._reason.labels(model, reason).set(1)
        for model in gone:
            self._ready.remove(model)
        for model in gone & self._probed:
            self._probed.remove(model)
            self._probe_ok.remove(model)

    def record_down(self, reason: str) -> None:
        """Records why no model is ready."""
        self.record(dict.fromkeys(self._reasons, reason))
        for model in self._probed:
            self.record_probe(model, is_ok=False)

    def record_probe(self, model: str, *, is_ok: bool) -> None:
        """Records whether a model's last probe was answered."""
        self._probed.add(model)
        self._probe_ok.labels(model).set(is_ok)

    @property
    def ready(self) -> tuple[bool, dict[str, Any]]:
        """Whether all models are ready, and the body of ``/ready``."""
        reasons = self._reasons
        is_ready = bool(reasons) and all(reason == NO_REASON for reason in reasons.values())
        models = {model: {"ready": reason == NO_REASON, "reason": reason} for model, reason in reasons.items()}
        return is_ready, {"ready": is_ready, "models": models}

    def metrics(self) -> bytes:
        """The metrics in the text format of Prometheus."""
        return generate_latest(self._registry)


class StatusServer:
    """Serves a Status over HTTP: ``/live``, ``/ready`` and ``/metrics``. Raises ServerStartError for a taken port."""

    def __init__(self, host: str, port: int, status: Status) -> None:
        try:
            check_free(host, port, "status", port_option="--status-port")
        except ValueError as error:
            raise ServerStartError(str(error)) from None
        self._server = _BoundedServer((host, port), _handler(status))
        self._thread = threading.Thread(target=self._server.serve_forever, name="rfm-status", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the HTTP server and its thread."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _BoundedServer(ThreadingHTTPServer):
    """An HTTP server that drops slow connections, after REQUEST_S or as soon as another caller needs the thread."""

    daemon_threads = True
    request_queue_size = 8 * MOST_CONNECTIONS  # connections beyond this number have to try again after a second

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        self._open: dict[socket.socket, None] = {}  # the oldest first
        self._lock = threading.Lock()
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        super().__init__(address, handler)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        deadline = threading.Timer(REQUEST_S, _cut, [request])
        deadline.daemon = True  # nobody waits for it at the end
        with self._lock:
            self._open[request] = None
            if len(self._open) > MOST_CONNECTIONS:
                oldest = next(iter(self._open))
                del self._open[oldest]
                _cut(oldest)
        try:
            deadline.start()
            super().process_request_thread(request, client_address)
        finally:
            deadline.cancel()
            with self._lock:
                self._open.pop(request, None)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Logs nothing: a caller that leaves without an answer is no fault."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


def _cut(connection: socket.socket) -> None:
    with suppress(OSError):  # it is closed
        connection.shutdown(socket.SHUT_RDWR)


def _handler(status: Status) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path == "/live":
                self._answer(HTTPStatus.OK, b"{}", "application/json")
            elif self.path == "/ready":
                is_ready, body = status.ready
                code = HTTPStatus.OK if is_ready else HTTPStatus.SERVICE_UNAVAILABLE
                self._answer(code, json.dumps(body).encode(), "application/json")
            elif self.path == "/metrics":
                self._answer(HTTPStatus.OK, status.metrics(), CONTENT_TYPE_LATEST)
            else:
                self._answer(HTTPStatus.NOT_FOUND, b"{}", "application/json")

        def _answer(self, code: HTTPStatus, body: bytes, content_type: str) -> None:
            self.send_response(code)
            self.send_header("Content-Type", content_type)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: Any) -> None:
            """Logs nothing: probes come every few seconds."""

    return Handler
