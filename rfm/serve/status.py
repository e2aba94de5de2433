# SPDX-License-Identifier: MIT
"""The status port of ``rfm serve``: live, ready, and metrics about restarts."""

from __future__ import annotations

import json
import socket
import sys
import threading
from collections.abc import Callable, Mapping
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Counter, Gauge, generate_latest

from rfm_client.contract.addresses import ListenAddress

NO_REASON = ""  # for a ready model
REQUEST_S = 5.0  # a connection may be silent this long


class Status:
    """Which models are ready, and why the others are not. more: further facts about a model, for ``/ready``"""

    def __init__(self, more: Callable[[str], Mapping[str, Any]] = lambda _model: {}) -> None:
        self._more = more
        self._reasons: Mapping[str, str] = {}
        self._details = ""  # behind each reason
        self._registry = CollectorRegistry()
        gauge = partial(Gauge, registry=self._registry)
        self._ready = gauge("rfm_serve_ready", "1: the model is ready.", ["model"])
        self._reason = gauge("rfm_serve_not_ready", "1: the model is not ready, and why.", ["model", "reason"])
        description = "Why Triton was started again: a model by name, or triton itself; gateway: the gateway was."
        self.start_s = gauge("rfm_serve_start_seconds", "How long Triton's last start took.")
        self.restarts = Counter("rfm_serve_restarts", description, ["what"], registry=self._registry)

    def record(self, reasons: Mapping[str, str]) -> None:
        """Record every model's state. reasons: why each model is not ready, or NO_REASON"""
        self._details = ""
        gone, before, self._reasons = self._reasons.keys() - reasons.keys(), self._reasons, dict(reasons)
        for model, reason in before.items():
            if reason not in (NO_REASON, reasons.get(model)):
                self._reason.remove(model, reason)
        for model, reason in reasons.items():
            self._ready.labels(model).set(reason == NO_REASON)
            self.restarts.labels(model)  # begins at 0, so that the first restart is an increase
            if reason != NO_REASON:
                self._reason.labels(model, reason).set(1)
        for model in gone:
            self._ready.remove(model)

    def record_down(self, reason: str, details: str = "") -> None:
        """Record why no model is ready. details: for ``/ready`` alone, since each reason is a metric's label"""
        self.record(dict.fromkeys(self._reasons, reason))
        self._details = details

    @property
    def ready(self) -> tuple[bool, dict[str, Any]]:
        """True if all models are ready, and the body of ``/ready``."""
        reasons = self._reasons
        is_ready = bool(reasons) and all(reason == NO_REASON for reason in reasons.values())
        models = {
            model: {"ready": reason == NO_REASON, "reason": reason + self._details, **self._more(model)}
            for model, reason in reasons.items()
        }
        return is_ready, {"ready": is_ready, "models": models}

    def metrics(self) -> bytes:
        """Return the metrics in Prometheus text format."""
        return generate_latest(self._registry)


class StatusServer(ThreadingHTTPServer):
    """HTTP server with ``/live``, ``/ready`` and ``/metrics``.

    Raises ServerStartError if the port is taken.
    """

    daemon_threads = True

    def __init__(self, host: str, port: int, status: Status) -> None:
        ListenAddress(host, port).check_free("status", port_option="--status-port")
        self.status = status
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        super().__init__((host, port), _Handler)
        threading.Thread(target=self.serve_forever, name="rfm-status", daemon=True).start()

    def close(self) -> None:
        """Stop the HTTP server and its thread."""
        self.shutdown()
        self.server_close()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log no error if a caller left before the response."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: StatusServer
    timeout = REQUEST_S

    def do_GET(self) -> None:
        code, body, content_type = HTTPStatus.OK, b"{}", "application/json"
        if self.path.partition("?")[0] == "/ready":  # 0.4.0 had /ready?strict
            is_ready, document = self.server.status.ready
            code = HTTPStatus.OK if is_ready else HTTPStatus.SERVICE_UNAVAILABLE
            body = json.dumps(document).encode()
        elif self.path == "/metrics":
            body, content_type = self.server.status.metrics(), CONTENT_TYPE_LATEST
        elif self.path != "/live":
            code = HTTPStatus.NOT_FOUND
        self.send_response(code)
        self.send_header("Content-Type", content_type)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        """Log nothing: probes come every few seconds."""
