# SPDX-License-Identifier: MIT
"""Servers that do not answer as they should. Stand-ins on a raw socket: a real Triton does not misbehave on demand."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import grpc
import numpy as np
import pytest
from tritonclient.grpc import service_pb2

from rfm_client import (
    DeadlineExceededError,
    InferenceFailedError,
    InvalidSampleError,
    RewardClient,
    RewardError,
    ServerUnavailableError,
    Trajectory,
)
from rfm_client.serving import Credentials, ServerStatus
from trajectories import random_trajectory

TIMEOUT_S = 1.0
WITHIN_S = 30.0
NO_JSON = b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nContent-Length: 9\r\n\r\n<html></>"
NO_ANSWER = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: 2\r\n\r\n{}"
BAD_GATEWAY = (
    b"HTTP/1.1 502 Bad Gateway\r\nContent-Type: text/html\r\nContent-Length: 24\r\n\r\n<h1>502 Bad Gateway</h1>"
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
    while connection.recv(65536):
        continue
    connection.close()


def dying(connection: socket.socket) -> None:
    connection.recv(65536)
    connection.close()


def saying(content: bytes) -> Callable[[socket.socket], None]:
    def answer(connection: socket.socket) -> None:
        connection.recv(65536)
        connection.sendall(content)
        connection.close()

    return answer


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


def test_a_redirect_is_told_and_never_followed() -> None:
    """It would carry frames and headers to an unknown server."""
    arrived: list[bytes] = []

    def stranger(connection: socket.socket) -> None:
        arrived.append(connection.recv(65536))
        connection.close()

    with listening(stranger) as other:
        head = "HTTP/1.1 307 Temporary Redirect\r\nLocation: {}\r\nContent-Length: 0\r\n\r\n"
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
        "(subsample, --max-frames), or share memory with a server on this host (shared_memory)"
    )


def test_triton_is_told_the_time_of_a_call_in_microseconds() -> None:
    """Triton drops later requests from a queue exported with ``queue_timeout_ms``."""
    told_us: list[int] = []

    def infer(request: service_pb2.ModelInferRequest, context: grpc.ServicerContext) -> None:
        told_us.append(request.parameters["timeout"].int64_param)
        context.abort(grpc.StatusCode.INVALID_ARGUMENT, "enough")

    handlers = {
        "ModelInfer": grpc.unary_unary_rpc_method_handler(
            infer, request_deserializer=service_pb2.ModelInferRequest.FromString
        )
    }
    server = grpc.server(ThreadPoolExecutor(1))
    server.add_generic_rpc_handlers([grpc.method_handlers_generic_handler("inference.GRPCInferenceService", handlers)])
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        with RewardClient(f"grpc://127.0.0.1:{port}") as client, pytest.raises(InvalidSampleError, match="enough"):
            client.progress(random_trajectory(0, 2), timeout_s=WITHIN_S)
    finally:
        server.stop(None)
    (waits_us,) = told_us
    assert 0.5 * WITHIN_S < waits_us / 1e6 <= WITHIN_S


def test_a_second_of_silence_costs_a_connection_its_later_calls() -> None:
    connections: list[socket.socket] = []

    def dumb(connection: socket.socket) -> None:
        connections.append(connection)
        silent(connection)

    with listening(dumb) as port, RewardClient(f"grpc://127.0.0.1:{port}", retry=False) as client:
        for timeout_s in (1.1, 0.2):
            with pytest.raises(DeadlineExceededError):
                client.progress(random_trajectory(0, 2), timeout_s=timeout_s)
        assert len(connections) == 2


def test_a_name_that_nobody_knows_is_told() -> None:
    client = RewardClient("grpc://rfm-servers.invalid:8001", retry=False, timeout_s=WITHIN_S)
    with client, pytest.raises(RewardError, match=r"Domain name not found|resol|DNS"):
        client.model_info()
