# SPDX-License-Identifier: MIT
"""Servers that do not answer as they should. Stand-ins on a raw socket: a real Triton does not misbehave on demand."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from rfm_client import (
    DeadlineExceededError,
    InferenceFailedError,
    RewardClient,
    RewardError,
    ServerUnavailableError,
)
from trajectories import random_trajectory

TIMEOUT_S = 1.0
NO_JSON = b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nContent-Length: 9\r\n\r\n<html></>"
NO_ANSWER = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: 2\r\n\r\n{}"
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


MISBEHAVING: dict[str, tuple[str, Callable[[socket.socket], None], type[RewardError]]] = {
    "http, no answer": ("http", silent, DeadlineExceededError),
    "grpc, no answer": ("grpc", silent, DeadlineExceededError),
    "http, dies": ("http", dying, ServerUnavailableError),
    "grpc, dies": ("grpc", dying, ServerUnavailableError),
    "http, no HTTP": ("http", saying(NO_HTTP), InferenceFailedError),
    "http, no JSON": ("http", saying(NO_JSON), InferenceFailedError),
    "http, no KServe answer": ("http", saying(NO_ANSWER), InferenceFailedError),
}


@pytest.mark.parametrize(("protocol", "answer", "error"), MISBEHAVING.values(), ids=MISBEHAVING)
def test_whatever_answers_the_error_is_ours(
    protocol: str, answer: Callable[[socket.socket], None], error: type[RewardError]
) -> None:
    with (
        listening(answer) as port,
        RewardClient(f"{protocol}://127.0.0.1:{port}", timeout_s=TIMEOUT_S) as client,
        pytest.raises(error),
    ):
        client.progress(random_trajectory(0, 2))


@pytest.mark.parametrize("protocol", ["grpc", "http"])
@pytest.mark.parametrize("answer", [silent, dying], ids=lambda answer: str(answer.__name__))
def test_a_server_that_does_not_answer_is_not_ready(protocol: str, answer: Callable[[socket.socket], None]) -> None:
    with listening(answer) as port, RewardClient(f"{protocol}://127.0.0.1:{port}", timeout_s=TIMEOUT_S) as client:
        assert not client.is_ready()
