# SPDX-License-Identifier: MIT
"""Errors that a request may have caused, requests that are too large, and names with several addresses."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

import grpc
import numpy as np
import pytest

from rfm_client import InvalidSampleError, ServerUnavailableError
from rfm_client.contract.triton import error_of, invalid_sample
from rfm_client.transport.connection import grpc_options
from rfm_client.transport.request_size import check_size

WITHIN_S = 30.0


def test_what_goes_through_shared_memory_does_not_count() -> None:
    inputs = {"frames": np.broadcast_to(np.zeros(1, np.uint8), 2**31), "task": np.array([b"lift"], np.object_)}
    check_size(inputs, {"frames"})
    with pytest.raises(InvalidSampleError, match=r"^frames: "):
        check_size(inputs, set())


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

    def serve(number: int) -> grpc.Server:
        def answer(content: bytes, _context: grpc.ServicerContext) -> bytes:
            counts[number] += 1
            return content

        handlers = {"Echo": grpc.unary_unary_rpc_method_handler(answer)}
        server = grpc.server(ThreadPoolExecutor(1), (grpc.method_handlers_generic_handler("test", handlers),))
        ports.append(server.add_insecure_port("127.0.0.1:0"))
        server.start()
        return server

    ports: list[int] = []
    servers = [serve(number) for number in range(2)]
    target = f"ipv4:{','.join(f'127.0.0.1:{port}' for port in ports)}"
    try:
        with grpc.insecure_channel(target, grpc_options("name:8001")) as channel:
            echo = channel.unary_unary("/test/Echo")
            end_s = time.monotonic() + WITHIN_S
            while not all(counts):
                assert echo(b"once") == b"once"
                assert time.monotonic() < end_s
    finally:
        for server in servers:
            server.stop(None)
