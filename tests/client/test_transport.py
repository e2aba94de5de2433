# SPDX-License-Identifier: MIT
"""Connections, limits of what is sent, and servers that do not answer as they should.

Those are stand-ins on a raw socket: a real Triton does not misbehave on demand.
"""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress

import grpc
import numpy as np
import pytest
from tritonclient.grpc import service_pb2
from tritonclient.utils import deserialize_bytes_tensor

from rfm_client import (
    DeadlineExceededError,
    InferenceFailedError,
    InvalidSampleError,
    ProgressSample,
    RewardClient,
    RewardError,
    ServerUnavailableError,
    Trajectory,
)
from rfm_client.contract import wire
from rfm_client.contract.triton import error_of, invalid_sample
from rfm_client.serving import Credentials, ServerStatus
from rfm_client.transport.calls import TritonTransport
from rfm_client.transport.connection import grpc_options
from rfm_client.transport.limits import MAX_BYTES, ConcurrencyLimiter, Deadline, check_size
from trajectories import random_trajectory

TIMEOUT_S = 1.0
WITHIN_S = 30.0
CLOSING = b"Connection: close\r\n"  # otherwise a caller may send its next request over a connection that just ended
NO_JSON = b"HTTP/1.1 200 OK\r\n" + CLOSING + b"Content-Type: text/html\r\nContent-Length: 9\r\n\r\n<html></>"
NO_ANSWER = b"HTTP/1.1 200 OK\r\n" + CLOSING + b"Content-Type: application/json\r\nContent-Length: 2\r\n\r\n{}"
BAD_GATEWAY = (
    b"HTTP/1.1 502 Bad Gateway\r\n"
    + CLOSING
    + b"Content-Type: text/html\r\nContent-Length: 24\r\n\r\n<h1>502 Bad Gateway</h1>"
)
NO_HTTP = b"220 smtp ready\r\n"


@contextmanager
def listening(answer: Callable[[socket.socket], None]) -> Iterator[int]:
    """A port on which every connection is given to ``answer``."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def accept() -> None:
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:  # closed: the test is over
                    return
                threading.Thread(target=answer, args=(connection,), daemon=True).start()

        threading.Thread(target=accept, daemon=True).start()
        yield server.getsockname()[1]


def silent(connection: socket.socket) -> None:
    with connection, suppress(ConnectionResetError):
        while connection.recv(65536):
            continue


def saying(content: bytes) -> Callable[[socket.socket], None]:
    def answer(connection: socket.socket) -> None:
        connection.recv(65536)
        connection.sendall(content)
        connection.close()

    return answer


dying = saying(b"")
Misbehaviour = Callable[[socket.socket], None]
MISBEHAVING: dict[str, tuple[str, Misbehaviour, type[RewardError], bool]] = {
    "http, no answer": ("http", silent, DeadlineExceededError, False),
    "grpc, no answer": ("grpc", silent, DeadlineExceededError, False),
    "http, dies": ("http", dying, ServerUnavailableError, True),
    "grpc, dies": ("grpc", dying, ServerUnavailableError, False),  # before there is a connection of gRPC's
    "http, a proxy without its server": ("http", saying(BAD_GATEWAY), ServerUnavailableError, True),
    "http, no HTTP": ("http", saying(NO_HTTP), InferenceFailedError, False),
    "http, no JSON": ("http", saying(NO_JSON), InferenceFailedError, False),
    "http, no KServe answer": ("http", saying(NO_ANSWER), InferenceFailedError, False),
}


@pytest.mark.slow
@pytest.mark.parametrize(("protocol", "answer", "kind", "may_have_ended"), MISBEHAVING.values(), ids=MISBEHAVING)
def test_whatever_answers_the_error_is_ours(
    protocol: str, answer: Misbehaviour, kind: type[RewardError], may_have_ended: bool
) -> None:
    """tests/triton asks a real Triton whether a server may have ended during a request over gRPC."""
    with (
        listening(answer) as port,
        # With retries the last try may still run at the deadline, which is another error.
        RewardClient(f"{protocol}://127.0.0.1:{port}", timeout_s=TIMEOUT_S, retry=False) as client,
    ):
        if answer in (silent, dying):
            assert not client.is_ready()
        with pytest.raises(kind) as caught:
            client.progress(random_trajectory(0, 2))
    assert caught.value.may_have_ended_server is may_have_ended


@pytest.mark.parametrize("refusal", ["403 Forbidden", "404 Not Found"])
def test_over_http_a_server_that_refuses_its_metadata_is_ready(refusal: str) -> None:
    """As ``--http-restricted-api`` of Triton does, and proxies that let only some paths through."""
    asked: list[bytes] = []

    def answer(connection: socket.socket) -> None:
        with connection, suppress(ConnectionResetError):
            while head := connection.recv(65536):
                asked.append(head.split()[1])
                status = "200 OK" if asked[-1].endswith(b"/ready") else refusal
                connection.sendall(f"HTTP/1.1 {status}\r\nContent-Length: 0\r\n\r\n".encode())

    with listening(answer) as port, RewardClient(f"http://127.0.0.1:{port}", model="rfm") as client:
        assert client.is_ready()
        assert client.is_ready()
    assert asked.count(b"/v2") <= 2  # one for each of the model's two names


def test_a_redirect_is_an_error_and_never_followed() -> None:
    """It would carry frames and headers to an unknown server."""
    arrived: list[socket.socket] = []
    with listening(arrived.append) as other:
        head = "HTTP/1.1 307 Temporary Redirect\r\nConnection: close\r\nLocation: {}\r\nContent-Length: 0\r\n\r\n"
        with listening(saying(head.format(f"http://127.0.0.1:{other}/v2").encode())) as port:
            url = f"http://127.0.0.1:{port}"
            told = (
                f"^{url}: expected an answer of Triton, got a redirect to 'http://127.0.0.1:{other}/v2': "
                "give that server's address as URL if you trust it"
            )
            with RewardClient(url, headers={"x-secret": "s"}, timeout_s=TIMEOUT_S) as client:
                with pytest.raises(InferenceFailedError, match=told):
                    client.progress(random_trajectory(0, 2))
                with pytest.raises(InferenceFailedError, match=told):
                    client.model_info()
                assert not client.is_ready()
                with pytest.raises(DeadlineExceededError, match="got a redirect to"):
                    client.wait_ready(TIMEOUT_S)
            with pytest.raises(InferenceFailedError, match=told):
                ServerStatus.read(url, credentials=Credentials(headers={"x-secret": "s"}))
    assert arrived == []


def test_a_request_over_two_gib_is_refused_before_it_is_copied() -> None:
    frames = np.broadcast_to(np.zeros(3, np.uint8), (2**13, 512, 512, 3))  # 6 GiB, all in the same three bytes
    client = RewardClient("grpc://127.0.0.1:1", timeout_s=WITHIN_S)
    with client, pytest.raises(InvalidSampleError) as refused:
        client.encode(Trajectory(frames=frames, task="stack the cups"))
    assert refused.value.message == (
        "frames: expected at most 2.15 GB in a request, got 6.44 GB; shrink the frames (resize, --resize), score fewer "
        "(subsample, or --fps for videos), or share memory with a server on this host (shared_memory)"
    )
    check_size({"frames": frames}, {"frames"})  # which go through shared memory
    texts = np.full(2**15, b"x" * 2**16, object)  # 2 GiB, all the same text
    with pytest.raises(InvalidSampleError, match=r"^task: expected at most 2\.15 GB in a request, got 2\.15 GB"):
        check_size({"task": texts}, ())


@contextmanager
def grpc_server(service: str, method: str, handler: grpc.RpcMethodHandler) -> Iterator[int]:
    """Yield the port of a server with one method."""
    server = grpc.server(ThreadPoolExecutor(1))
    server.add_generic_rpc_handlers([grpc.method_handlers_generic_handler(service, {method: handler})])
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        yield port
    finally:
        server.stop(None)


def test_requests_to_triton_carry_the_timeout_of_the_call_in_microseconds() -> None:
    """Triton drops later requests from a queue exported with ``queue_timeout_ms``."""
    told_us: list[int] = []

    def infer(request: service_pb2.ModelInferRequest, context: grpc.ServicerContext) -> None:
        told_us.append(request.parameters["timeout"].int64_param)
        context.abort(grpc.StatusCode.INVALID_ARGUMENT, "enough")

    handler = grpc.unary_unary_rpc_method_handler(infer, service_pb2.ModelInferRequest.FromString)
    with (
        grpc_server("inference.GRPCInferenceService", "ModelInfer", handler) as port,
        RewardClient(f"grpc://127.0.0.1:{port}") as client,
        pytest.raises(InvalidSampleError, match="enough"),
    ):
        client.progress(random_trajectory(0, 2), timeout_s=WITHIN_S)
    (waits_us,) = told_us
    assert 0.5 * WITHIN_S < waits_us / 1e6 <= WITHIN_S


@pytest.mark.parametrize("side_px", [5, 60, 840], ids=["length of 2 bytes", "3 bytes", "4 bytes"])
def test_a_grpc_request_holds_every_tensor_whole(side_px: int) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (1, side_px, 2 * side_px, 3), np.uint8)[:, :, ::2]
    sent: list[service_pb2.ModelInferRequest] = []

    def infer(request: service_pb2.ModelInferRequest, context: grpc.ServicerContext) -> None:
        sent.append(request)
        context.abort(grpc.StatusCode.INVALID_ARGUMENT, "enough")

    async def ask(port: int) -> None:
        transport = TritonTransport(f"grpc://127.0.0.1:{port}")
        for number in (1, 2):  # the second request begins as the first
            with pytest.raises(InvalidSampleError, match="enough"):
                await transport.infer("m", inputs, ("progress",), WITHIN_S, request_id=f"id-{number}")
        await transport.close()

    inputs = wire.encode_samples([ProgressSample(Trajectory(frames=frames, task="öffne"))])
    handler = grpc.unary_unary_rpc_method_handler(infer, service_pb2.ModelInferRequest.FromString)
    with grpc_server("inference.GRPCInferenceService", "ModelInfer", handler) as port:
        asyncio.run(ask(port))
    assert [(request.id, request.model_name) for request in sent] == [("id-1", "m"), ("id-2", "m")]
    for request in sent:
        assert [output.name for output in request.outputs] == ["progress"]
        assert [(each.name, tuple(each.shape)) for each in request.inputs] == [(n, a.shape) for n, a in inputs.items()]
        *contents, text = request.raw_input_contents
        assert contents == [array.tobytes() for name, array in inputs.items() if name != wire.TASK]
        assert deserialize_bytes_tensor(text).tolist() == ["öffne".encode()]


def test_the_error_for_an_unknown_host_name_says_so() -> None:
    client = RewardClient("grpc://rfm-servers.invalid:8001", retry=False, timeout_s=WITHIN_S)
    with client, pytest.raises(RewardError, match=r"Domain name not found|resol|DNS"):
        client.model_info()


@pytest.mark.parametrize(
    ("message", "may_have_ended"),
    [
        ("Stream removed (Socket closed)", True),
        ("Stream removed (recvmsg:Connection reset by peer (104))", True),
        ("Stream removed (sendmsg: Broken pipe (32))", True),
        ("upstream connect error or disconnect/reset before headers. reset reason: connection termination", True),
        ("upstream connect error or disconnect/reset before headers. reset reason: remote connection failure", False),
        (
            "failed to connect to all addresses; last error: UNKNOWN: ipv4:10.0.0.1:8001: Connection reset by peer",
            False,
        ),
        ("connections to all backends failing; last error: UNKNOWN: ipv4:10.0.0.1:1: Connection reset by peer", False),
        ("the queue is full: 8 requests wait already", False),
        ("Stub process 'rfm_0_0' is not healthy.", True),
    ],
)
def test_which_errors_a_request_may_have_caused(message: str, may_have_ended: bool) -> None:
    error = error_of("StatusCode.UNAVAILABLE", message, invalid_sample)
    assert isinstance(error, ServerUnavailableError)
    assert error.may_have_ended_server is may_have_ended


def test_requests_are_spread_over_the_addresses_of_a_name() -> None:
    """A list of addresses stands for the name, which would need a DNS server."""
    counts = [0, 0]

    def echo(number: int) -> grpc.RpcMethodHandler:
        def answer(content: bytes, _context: grpc.ServicerContext) -> bytes:
            counts[number] += 1
            return content

        return grpc.unary_unary_rpc_method_handler(answer)

    with grpc_server("test", "Echo", echo(0)) as one, grpc_server("test", "Echo", echo(1)) as other:
        target = f"ipv4:127.0.0.1:{one},127.0.0.1:{other}"
        with grpc.insecure_channel(target, grpc_options("name:8001")) as channel:
            ask = channel.unary_unary("/test/Echo")
            end_s = time.monotonic() + WITHIN_S
            while not all(counts):
                assert ask(b"once") == b"once"
                assert time.monotonic() < end_s


def test_a_call_that_ends_long_after_its_deadline_says_that_its_process_stood_still() -> None:
    """Such as one that SIGSTOP stopped. The test moves the deadline into the past instead."""
    deadline = Deadline(60)
    assert str(deadline.exceeded("grpc://a:1")) == "grpc://a:1: no answer within 60 s"
    deadline.at_s -= 312
    told = "grpc://a:1: no answer within 60 s; 312 s have passed, as this process was stopped, or busy with other work"
    assert str(deadline.exceeded("grpc://a:1")) == told


def test_bytes_in_flight_are_bounded_and_more_than_the_bound_goes_alone() -> None:
    async def ask() -> None:
        room = ConcurrencyLimiter(10).room
        async with room(MAX_BYTES // 2, Deadline(1)), room(MAX_BYTES // 2 - 1, Deadline(1)):
            with pytest.raises(DeadlineExceededError):
                async with room(2, Deadline(0.05)):
                    pytest.fail("there was no room")
            async with room(1, Deadline(1)):
                pass
        async with room(3 * MAX_BYTES, Deadline(1)):
            with pytest.raises(DeadlineExceededError):
                async with room(0, Deadline(0.05)):
                    pytest.fail("there was no room")
        async with room(MAX_BYTES, Deadline(1)):  # a call that gives up returns its bytes
            pass

    asyncio.run(ask())
