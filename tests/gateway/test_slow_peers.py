# SPDX-License-Identifier: MIT
"""Peers that send slowly, hold connections, or show no key, beside callers who want scores."""

from __future__ import annotations

import asyncio
import http.client
import resource
import socket
import threading
from collections.abc import AsyncGenerator, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from unittest.mock import Mock

import pytest
import requests
import uvicorn
from fastapi import HTTPException, Request
from fastapi.responses import StreamingResponse
from prometheus_client import Gauge
from uvicorn.server import ServerState

from gateway_requests import FIRST, NO_KEY, TINY, Triton, ask_json, failure, paused, post_body, progress
from gateways import WITHIN_S, answers, free_port, poll, running
from rfm_client.contract.descriptors import MOST
from rfm_gateway import GatewayConfig
from rfm_gateway.admission import PACE_BYTES, Room, Turn, arriving
from rfm_gateway.app import create_app
from rfm_gateway.connections import Connection

KEY, REFUSALS = "open sesame", "rfm_gateway.refusals"  # the logger whose lines are counted
SETTINGS = GatewayConfig(triton="grpc://127.0.0.1:1", max_in_flight=1, max_waiting=0)


HEAD_OF_BODY = b"POST /evaluate_batch HTTP/1.1\r\nHost: gateway\r\nContent-Length: 1000\r\n\r\n"
LONG_S = 10 * WITHIN_S


@contextmanager
def listening(limit_concurrency: int | None = None, api_key: str | None = None, **bounds_s: float) -> Iterator[int]:
    """Run a gateway without a Triton in this process, with short bounds and one large answer. Yields the port."""
    app, port = create_app(SETTINGS, api_key), free_port()
    app.add_api_route("/large", lambda: StreamingResponse([bytes(2**20)] * 32))
    hasty = type("Hasty", (Connection,), {"head_s": 0.2, "rest_s": 0.2, **bounds_s})
    config = uvicorn.Config(app, port=port, http=hasty, limit_concurrency=limit_concurrency, log_config=None)
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
    """Wait until the gateway closes the connection."""
    connection.settimeout(WITHIN_S)
    while connection.recv(65536):
        pass
    return True


CHUNKED = b"POST /evaluate_batch HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n2\r\n[]\r\n"
ENDLESS = {
    "a trailer": CHUNKED + b"0\r\nx: " + b"a" * 2**21,
    "trailers": CHUNKED + b"0\r\n" + b"a: b\r\n" * 2**19,
    "an extension of a chunk": CHUNKED + b"1;" + b"a" * 2**21,
    "a header": b"GET / HTTP/1.1\r\nHost: localhost\r\nx: " + b"a" * 2**20,
    "headers": b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"a: b\r\n" * 2**17,
    "a head behind a body that is refused": HEAD_OF_BODY[:-2] + b"\r\n" + b"0" * 1000 + b"GET /" + b"a" * 2**20,
}


@pytest.mark.parametrize("sent", ENDLESS.values(), ids=ENDLESS)
def test_what_has_no_end_is_cut_off(sent: bytes, caplog: pytest.LogCaptureFixture) -> None:
    with listening(head_s=LONG_S, rest_s=LONG_S) as port, socket.create_connection(("127.0.0.1", port)) as peer:
        with suppress(ConnectionError):
            peer.sendall(sent)
            closed_by_peer(peer)
        with pytest.raises(ConnectionError):
            for _ in range(100):
                peer.sendall(sent)
    assert {record.name for record in caplog.records} <= {REFUSALS}


@pytest.mark.parametrize("length", [1, 9000])
def test_a_request_for_a_websocket_is_an_ordinary_request(length: int, caplog: pytest.LogCaptureFixture) -> None:
    upgrade = b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nContent-Length: 5\r\n\r\n"
    with listening() as port, socket.create_connection(("127.0.0.1", port)) as peer:
        peer.sendall(b"GET /" + b"a" * length + b" HTTP/1.1\r\nHost: localhost\r\n" + upgrade)
        assert peer.recv(12) == b"HTTP/1.1 404"
        assert closed_by_peer(peer)
    assert {record.name for record in caplog.records} <= {REFUSALS}


def test_a_peer_that_sends_many_requests_at_a_time_is_cut_off(caplog: pytest.LogCaptureFixture) -> None:
    with listening(head_s=LONG_S) as port, socket.create_connection(("127.0.0.1", port)) as peer:
        peer.sendall(b"GET /docs HTTP/1.1\r\nHost: localhost\r\n\r\n" * 100)
        peer.settimeout(WITHIN_S)
        got = b""
        with suppress(ConnectionError):
            while chunk := peer.recv(65536):
                got += chunk
    assert got.count(b"HTTP/1.1 200") <= 1
    assert {record.name for record in caplog.records} <= {REFUSALS}


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
    with listening(api_key=KEY) as port, socket.create_connection(("127.0.0.1", port), WITHIN_S) as slow:
        slow.sendall(HEAD_OF_BODY)
        assert slow.recv(65536).startswith(b"HTTP/1.1 401 ")
        slow.sendall(b"[")
        assert closed_by_peer(slow)


def test_a_refused_body_may_take_longer_than_a_head_so_that_its_sender_gets_the_answer() -> None:
    with (
        listening(api_key=KEY, rest_s=LONG_S) as port,
        socket.create_connection(("127.0.0.1", port), WITHIN_S) as slow,
    ):
        slow.sendall(HEAD_OF_BODY)
        assert slow.recv(65536).startswith(b"HTTP/1.1 401 ")
        slow.sendall(b"[")
        for _ in range(2):
            with socket.create_connection(("127.0.0.1", port)) as silent:
                assert closed_by_peer(silent)
        slow.sendall(b" " * 999 + b"GET /docs HTTP/1.1\r\nHost: gateway\r\n\r\n")
        assert slow.recv(65536).startswith(b"HTTP/1.1 200 ")


def test_a_caller_that_reads_no_answer_is_cut_off() -> None:
    with listening(limit_concurrency=1) as port, socket.create_connection(("127.0.0.1", port), WITHIN_S) as stuck:
        stuck.sendall(b"GET /large HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert stuck.recv(1)
        poll(lambda: requests.get(f"http://127.0.0.1:{port}/openapi.json").ok)


def test_a_caller_that_reads_an_answer_slowly_is_cut_off_only_when_it_stops() -> None:
    async def serve() -> None:
        unread_bytes = [3 * PACE_BYTES, 2 * PACE_BYTES, PACE_BYTES, 1]
        transport, is_cut_off = Mock(asyncio.Transport), asyncio.Event()
        transport.get_extra_info.return_value = None
        transport.get_write_buffer_size.side_effect = unread_bytes
        transport.abort.side_effect = is_cut_off.set
        connection = Connection(uvicorn.Config(create_app(SETTINGS)), ServerState(), {})
        connection.rest_s = 0.01
        connection.connection_made(transport)
        connection.pause_writing()
        await asyncio.wait_for(is_cut_off.wait(), WITHIN_S)
        assert transport.get_write_buffer_size.call_count == len(unread_bytes)

    asyncio.run(serve())


def test_many_connections_without_a_request_leave_descriptors() -> None:
    """Beyond those that get a 503, connections are closed at once."""
    with listening(limit_concurrency=2, head_s=LONG_S) as port, ExitStack() as stack:
        first, *_, late = (
            stack.enter_context(socket.create_connection(("127.0.0.1", port), WITHIN_S)) for _ in range(4)
        )
        assert closed_by_peer(late)
        first.sendall(HEAD_OF_BODY)
        assert first.recv(65536).startswith(b"HTTP/1.1 503 ")


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
    """A request above the bound takes a place before it reads on."""

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
def few_descriptors(free: int) -> Iterator[None]:
    """Leave this process and those it starts ``free`` descriptors."""
    count = sum(1 for _ in Path("/proc/self/fd").iterdir()) + free
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
            assert failure(ask_json(gateway, [progress(FIRST)]), 401) == NO_KEY
        assert connection.getresponse().status == 200
        connection.close()
