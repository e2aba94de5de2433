# SPDX-License-Identifier: MIT
"""Peers that send slowly, hold connections, or show no key, beside callers who want scores."""

from __future__ import annotations

import asyncio
import http.client
import resource
import socket
import threading
from collections.abc import AsyncGenerator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import requests
import uvicorn
from fastapi import HTTPException, Request
from prometheus_client import Gauge

from gateway_requests import FIRST, TINY, Triton, ask_json, failure, paused, post_body, progress
from gateways import WITHIN_S, answers, free_port, poll, running
from rfm_client.contract.descriptors import MOST
from rfm_gateway.admission import PACE_BYTES, Room, Turn, arriving
from rfm_gateway.app import create_app
from rfm_gateway.config import GatewayConfig
from rfm_gateway.connections import Connection

KEY = "open sesame"
SETTINGS = GatewayConfig(triton="grpc://127.0.0.1:1", max_in_flight=1, max_waiting=0)


class Hasty(Connection):
    head_s = 0.2


@contextmanager
def listening(limit_concurrency: int | None = None, api_key: str | None = None) -> Iterator[int]:
    """The port of a gateway inside this process, before no Triton."""
    app, port = create_app(SETTINGS, api_key), free_port()
    config = uvicorn.Config(app, port=port, http=Hasty, limit_concurrency=limit_concurrency, log_config=None)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        poll(lambda: answers(f"http://127.0.0.1:{port}"))
        yield port
    finally:
        server.should_exit = True
        thread.join(WITHIN_S)


def closed_by_peer(connection: socket.socket) -> bool:
    """Waits for the end of what the gateway sends."""
    connection.settimeout(WITHIN_S)
    while connection.recv(65536):
        pass
    return True


HEADS = {"nothing": b"", "half a head": b"POST /evaluate_batch HTTP/1.1\r\nHos"}


@pytest.mark.parametrize("sent", HEADS.values(), ids=HEADS)
def test_a_connection_without_a_whole_head_is_closed_and_one_with_it_is_not(sent: bytes) -> None:
    with listening() as port:
        used = http.client.HTTPConnection("127.0.0.1", port, timeout=WITHIN_S)
        for _ in range(2):
            used.request("GET", "/docs")
            assert used.getresponse().read()
            with socket.create_connection(("127.0.0.1", port)) as slow:
                slow.sendall(sent)
                assert closed_by_peer(slow)
        used.close()


def test_a_refused_body_that_does_not_end_is_no_reason_to_stay() -> None:
    head = b"POST /evaluate_batch HTTP/1.1\r\nHost: gateway\r\nContent-Length: 1000\r\n\r\n"
    with listening(api_key=KEY) as port, socket.create_connection(("127.0.0.1", port), WITHIN_S) as slow:
        slow.sendall(head)
        assert slow.recv(65536).startswith(b"HTTP/1.1 401 ")
        slow.sendall(b"[")
        assert closed_by_peer(slow)


def test_more_connections_than_allowed_are_a_503() -> None:
    with listening(limit_concurrency=2) as port, requests.Session() as kept, requests.Session() as also_kept:
        url = f"http://127.0.0.1:{port}"
        for session in (kept, also_kept):
            poll(lambda session=session: session.get(f"{url}/openapi.json").ok)  # type: ignore[misc]
        response = requests.get(f"{url}/openapi.json")
        assert failure(response, 503) == "expected fewer connections at a time, got more"
        assert response.headers["Retry-After"] == "1"
        kept.close()
        poll(lambda: requests.get(f"{url}/openapi.json").ok)


def test_a_body_that_does_not_keep_the_pace_is_not_waited_for() -> None:
    messages = [{"type": "http.request", "body": b"x" * size, "more_body": True} for size in (PACE_BYTES, 1)]

    async def receive() -> dict[str, object]:
        return messages.pop(0) if messages else await asyncio.Event().wait()  # type: ignore[return-value]

    async def read() -> list[int]:
        request = Request({"type": "http", "headers": []}, receive)
        sizes = []
        with pytest.raises(TimeoutError):
            async for chunk in arriving(request, 10 * PACE_BYTES, WITHIN_S, pace_s=0.01):
                sizes.append(len(chunk))
        return sizes

    assert asyncio.run(read()) == [PACE_BYTES, 1]


def test_bodies_without_a_place_take_bounded_memory() -> None:
    """Beyond it, a request takes its place before it reads on."""

    async def serve() -> None:
        in_flight, waiting = (Gauge(name, "", registry=None) for name in ("in_flight", "waiting"))
        room = Room(SETTINGS, in_flight, waiting, ahead_bytes=3)
        is_sent = asyncio.Event()

        async def body(*chunks: bytes) -> AsyncGenerator[bytes, None]:
            for chunk in chunks:
                yield chunk
            await is_sent.wait()

        small, large, late = Turn(room), Turn(room), Turn(room)
        reading = asyncio.create_task(anext(small.admitted(body(b"12"))))
        await asyncio.sleep(0)  # it reads
        assert await anext(large.admitted(body(b"1", b"23"))) == b"123"
        assert (in_flight._value.get(), room.ahead_bytes) == (1, 1)
        with pytest.raises(HTTPException, match="503: expected at most 1 evaluations at a time, got more"):
            await anext(late.admitted(body()))
        large.end()
        assert in_flight._value.get() == 0
        is_sent.set()
        assert await reading == b"12"
        small.end()
        assert room.ahead_bytes == 3

    asyncio.run(serve())


@contextmanager
def few_descriptors(count: int) -> Iterator[None]:
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (count, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


@pytest.mark.triton
def test_callers_without_the_key_wait_for_no_place_and_the_gateway_has_all_descriptors_it_may(
    triton: Triton, tmp_path: Path
) -> None:
    options = ("--max-in-flight", "1", "--max-waiting", "0")
    with ExitStack() as stack:
        with few_descriptors(256):
            gateway = stack.enter_context(running(triton.endpoints, tmp_path, TINY, *options, RFM_GATEWAY_API_KEY=KEY))
        soft, hard = resource.prlimit(gateway.process.pid, resource.RLIMIT_NOFILE)
        assert soft == min(hard, MOST)
        with paused(triton):
            connection = post_body(gateway, progress(FIRST), {"X-API-Key": KEY})
            poll(lambda: "requests_in_flight 1.0" in gateway.get("/metrics", headers={"X-API-Key": KEY}).text)
            expected = "key: expected X-API-Key or Authorization: Bearer, got another or none"
            assert failure(ask_json(gateway, [progress(FIRST)]), 401) == expected
        assert connection.getresponse().status == 200
        connection.close()
