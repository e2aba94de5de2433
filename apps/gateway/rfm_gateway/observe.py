# SPDX-License-Identifier: MIT
"""Count requests for Prometheus, limit concurrent ones, and cancel work that is late or whose caller has hung up."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Coroutine
from typing import Any, TypeVar

import anyio
from fastapi import HTTPException, Request
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rfm_client import DeadlineExceededError
from rfm_client.serving import begin_request
from rfm_gateway.config import MIB, GatewayConfig

Returned = TypeVar("Returned")

ENDPOINTS = (
    "/evaluate_batch",
    "/evaluate_batch_npy",
    "/viewer/score",
    "/viewer/compare",
    "/gpu_status",
    "/health",
    "/model_info",
    "/metrics",
)
CALLER_LEFT = 499  # as nginx logs it

REQUEST_ID_HEADER = "X-Request-ID"
RETRY_AFTER = {"Retry-After": "1"}
LARGEST_BODIES = 8  # bodies of the largest size that may be in memory together

_BUCKETS_S = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0)


class GatewayMetrics:
    """The Prometheus metrics for one gateway."""

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
        self.samples = Counter("rfm_gateway_samples", "Samples scored.", ("sample_type",), registry=self._registry)
        self.in_flight = Gauge("rfm_gateway_requests_in_flight", "Evaluations under way.", registry=self._registry)
        self.waiting = Gauge("rfm_gateway_requests_waiting", "Evaluations not begun.", registry=self._registry)

    def count(self, path: str, code: int, duration_s: float) -> None:
        """Count a request that was answered with the status ``code``."""
        endpoint = path if path in ENDPOINTS else "other"  # callers choose the path, and each label value takes memory
        self.requests.labels(endpoint, str(code)).inc()
        self.durations.labels(endpoint).observe(duration_s)

    def text(self) -> bytes:
        """Return the metrics in Prometheus text format."""
        return generate_latest(self._registry)


class Places:
    """Places for evaluations: ``max_in_flight`` at a time; ``max_waiting`` more wait, first come, first served.

    Their bodies share the memory that LARGEST_BODIES of ``max_body_mib`` take.
    """

    def __init__(self, config: GatewayConfig, metrics: GatewayMetrics) -> None:
        self._config = config
        self._places = anyio.CapacityLimiter(config.max_in_flight)
        self._free_bytes = LARGEST_BODIES * config.max_body_mib * MIB
        metrics.in_flight.set_function(lambda: self._places.borrowed_tokens)
        metrics.waiting.set_function(lambda: self._places.statistics().tasks_waiting)

    async def taken(self, request: Request) -> AsyncGenerator[None, None]:
        """Endpoint dependency: take a place before the body is read, and give it back after the response.

        ``request.state.hold(num_bytes)`` then takes memory for a piece of the body.

        Both raise HTTPException 503: if too many wait, no place is free within ``timeout_s``, or the memory is taken.
        """
        detail = f"expected at most {self._config.max_in_flight} evaluations at a time, got more"
        full, places, held_bytes = HTTPException(503, detail, RETRY_AFTER), self._places, 0

        def hold(num_bytes: int) -> None:
            nonlocal held_bytes
            if num_bytes > self._free_bytes:
                most = f"{LARGEST_BODIES * self._config.max_body_mib} MiB of bodies at a time"
                raise HTTPException(503, f"body: expected at most {most}, got more; try again", RETRY_AFTER)
            held_bytes += num_bytes
            self._free_bytes -= num_bytes

        if places.available_tokens < 1 and places.statistics().tasks_waiting >= self._config.max_waiting:
            raise full
        with anyio.move_on_after(self._config.timeout_s) as waiting:
            await places.acquire_on_behalf_of(request)
        if waiting.cancelled_caught:
            raise full
        request.state.hold = hold
        try:
            yield
        finally:
            self._free_bytes += held_bytes
            places.release_on_behalf_of(request)


class RequestMiddleware:
    """ASGI middleware that gives requests ids, and counts and times them."""

    def __init__(self, app: ASGIApp, metrics: GatewayMetrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request, and count it once it is answered."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started_s = time.perf_counter()
        request_id = begin_request(Headers(scope=scope).get(REQUEST_ID_HEADER, ""))
        scope.setdefault("state", {})["request_id"] = request_id
        code = 500  # unless a response begins

        async def send_counted(message: Message) -> None:
            nonlocal code
            if message["type"] == "http.response.start":
                code = message["status"]
                MutableHeaders(scope=message)[REQUEST_ID_HEADER] = request_id
            await send(message)

        try:
            await self._app(scope, receive, send_counted)
        finally:
            if scope["method"] != "HEAD":  # which rfm serve asks each second
                self._metrics.count(scope["path"], code, time.perf_counter() - started_s)


class CallerLeftError(Exception):
    """The caller hung up before the answer was ready."""


async def while_connected(request: Request, work: Coroutine[Any, Any, Returned]) -> Returned:
    """Return the result of ``work``. Read the request body before.

    If the caller hangs up, cancels ``work`` with its requests to Triton and raises CallerLeftError.
    """
    working = asyncio.create_task(work)
    leaving = asyncio.create_task(_disconnected(request))
    try:
        await asyncio.wait((working, leaving), return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            raise CallerLeftError("the caller has hung up")
        return working.result()
    finally:
        for task in (working, leaving):
            task.cancel()
        await asyncio.gather(working, leaving, return_exceptions=True)


async def within(timeout_s: float, work: Coroutine[Any, Any, Returned]) -> Returned:
    """Return the result of ``work``, which calls Triton. Cancels late work and raises DeadlineExceededError."""
    try:
        return await asyncio.wait_for(work, timeout_s)
    except (asyncio.TimeoutError, DeadlineExceededError) as error:
        raise DeadlineExceededError(f"Triton: no answer within {timeout_s:g} s") from error


async def _disconnected(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
