# SPDX-License-Identifier: MIT
"""What the gateway counts, in Prometheus' terms, and how many requests it lets in at a time."""

from __future__ import annotations

import asyncio
import secrets
import time

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rfm_client.contract.errors import DeadlineExceededError
from rfm_client.contract.names import PROBE_PREFIX
from rfm_client.contract.wire import REQUEST_ID
from rfm_client.transport.deadline import Deadline, timeout
from rfm_gateway.body import MULTIPART_ENDPOINTS
from rfm_gateway.config import GatewayConfig
from rfm_gateway.memory import RETRY_AFTER

EVALUATIONS = ("/evaluate_batch", *MULTIPART_ENDPOINTS)
ENDPOINTS = (*EVALUATIONS, "/gpu_status", "/health", "/model_info", "/metrics")
CALLER_LEFT = 499  # as other servers log it; nobody reads the answer
REJECTIONS = {
    401: "key",
    408: "slow",
    413: "size",
    415: "format",
    422: "invalid",
    CALLER_LEFT: "hung_up",
    503: "unavailable",
    504: "deadline",
}

REQUEST_ID_HEADER = "X-Request-ID"
_ID_BYTES = 8  # of chance, where a request comes without an id

_BUCKETS_S = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0)


class Metrics:
    """The Prometheus metrics of one gateway."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        labels = ("endpoint", "code")
        self.requests = Counter("rfm_gateway_requests", "Requests answered.", labels, registry=self._registry)
        self.durations = Histogram(
            "rfm_gateway_request_duration_seconds",
            "From a request's first byte to its answer's last.",
            ("endpoint",),
            buckets=_BUCKETS_S,
            registry=self._registry,
        )
        self.rejections = Counter(
            "rfm_gateway_rejections",
            "Evaluations that were not scored, by reason.",
            ("reason",),
            registry=self._registry,
        )
        self.samples = Counter("rfm_gateway_samples", "Samples scored.", ("sample_type",), registry=self._registry)
        self.in_flight = Gauge("rfm_gateway_requests_in_flight", "Evaluations under way.", registry=self._registry)
        self.waiting = Gauge("rfm_gateway_requests_waiting", "Evaluations not begun.", registry=self._registry)

    def count(self, path: str, code: int, duration_s: float) -> None:
        """Counts a request that was answered with the status ``code``."""
        endpoint = path if path in ENDPOINTS else "other"  # not any path that a caller makes up
        self.requests.labels(endpoint, str(code)).inc()
        self.durations.labels(endpoint).observe(duration_s)
        if path in EVALUATIONS and code >= 400:
            self.rejections.labels(REJECTIONS.get(code, "other")).inc()

    def text(self) -> bytes:
        """The metrics in the text format of Prometheus."""
        return generate_latest(self._registry)


class Observed:
    """ASGI middleware: names, times and counts every request, and lets in as many evaluations as ``config`` says."""

    def __init__(self, app: ASGIApp, metrics: Metrics, config: GatewayConfig) -> None:
        self._app = app
        self._metrics = metrics
        self._config = config
        self._room = asyncio.Semaphore(config.max_in_flight)
        self._waiting = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serves a request, and counts it with its answer."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started_s = time.perf_counter()
        request_id = _request_id(scope)
        state = scope.setdefault("state", {})
        state["request_id"], state["begin_by"] = request_id, Deadline(self._config.timeout)
        code = 500  # if nothing is answered

        async def send_counted(message: Message) -> None:
            nonlocal code
            if message["type"] == "http.response.start":
                code = message["status"]
                MutableHeaders(scope=message)[REQUEST_ID_HEADER] = request_id
            await send(message)

        try:
            if scope["path"] not in EVALUATIONS:
                await self._app(scope, receive, send_counted)
            elif not await self._has_entered(state["begin_by"]):
                refused = {"detail": f"expected at most {self._config.max_in_flight} evaluations at a time, got more"}
                await JSONResponse(refused, 503, RETRY_AFTER)(scope, receive, send_counted)
            else:
                await self._evaluated(scope, receive, send_counted)
        finally:
            self._metrics.count(scope["path"], code, time.perf_counter() - started_s)

    async def _has_entered(self, deadline: Deadline) -> bool:
        """Whether there is room in time, first come, first served."""
        if self._room.locked() and self._waiting >= self._config.max_waiting:
            return False
        self._waiting += 1
        self._metrics.waiting.set(self._waiting)
        try:
            async with timeout(deadline.remaining_s()):
                return await self._room.acquire()
        except (asyncio.TimeoutError, DeadlineExceededError):  # in Python 3.10 not the built-in TimeoutError
            return False
        finally:
            self._waiting -= 1
            self._metrics.waiting.set(self._waiting)

    async def _evaluated(self, scope: Scope, receive: Receive, send: Send) -> None:
        self._metrics.in_flight.inc()
        try:
            await self._app(scope, receive, send)
        finally:
            self._metrics.in_flight.dec()
            self._room.release()


def _request_id(scope: Scope) -> str:
    """The caller's request id, or a new one.

    A new one replaces an id that no log could hold, or that would hide the request from metrics.
    """
    given = Headers(scope=scope).get(REQUEST_ID_HEADER, "")
    if REQUEST_ID.fullmatch(given) and not given.startswith(PROBE_PREFIX):
        return given
    return secrets.token_hex(_ID_BYTES)
