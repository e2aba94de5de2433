# SPDX-License-Identifier: MIT
"""Limits of bodies, connections, and evaluations at a time. A stand-in for Triton answers when a test lets it."""

from __future__ import annotations

import json
import subprocess
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import requests

from gateway_requests import (
    FIRST,
    MULTIPART,
    NAMED,
    NO_KEY,
    answered,
    ask_json,
    begun,
    dumped,
    failure,
    npy,
    post_body,
    progress,
)
from gateways import Address, StandIn, inside, listening
from rfm_gateway.body import _read_npy
from rfm_gateway.config import MIB
from rfm_gateway.form import Form
from servers import wait_for

KEY = "open sesame"
NOTHING: Any = {}  # no sample
SCORED = {"outputs_progress": {"progress_pred": [[pytest.approx(0.1)] * 3]}}  # of FIRST, by the stand-in


@pytest.fixture(scope="module")
def triton() -> StandIn:
    return StandIn(served=["rfm"])


@pytest.fixture(scope="module")
def strict(triton: StandIn) -> Iterator[Address]:
    """Two evaluations at a time, none waits."""
    with listening(triton, timeout_s=0.5, max_in_flight=2, max_waiting=0) as started:
        yield started


@pytest.fixture(autouse=True)
def _open(triton: StandIn) -> None:
    triton.is_open.set()


HALVES = {
    "/evaluate_batch": ({"Content-Length": "100"}, b'{"samples": ['),
    "/evaluate_batch_npy": ({"Content-Length": "100", "Content-Type": MULTIPART}, NAMED),
}


@pytest.mark.parametrize(("path", "half"), HALVES.items(), ids=HALVES)
def test_a_body_that_does_not_come_is_a_408(strict: Address, path: str, half: Any) -> None:
    connection = begun(strict, *half, path=path)
    wait_for(lambda: strict.metric("requests_in_flight") == 1)
    assert answered(ask_json(strict, [progress(FIRST)])).items() >= SCORED.items()
    response = connection.getresponse()
    assert (response.status, response.getheader("Connection")) == (408, "close")
    assert json.loads(response.read())["detail"] == "body: expected all of it in time, got a part"
    connection.close()


def test_a_caller_who_leaves_in_the_middle_of_a_body_is_a_400(strict: Address) -> None:
    for path, half in HALVES.items():
        begun(strict, *half, path=path).close()
        wait_for(lambda path=path: strict.metric("requests_total", endpoint=path, code="400") >= 1)  # type: ignore[misc]


def test_a_caller_who_hangs_up_cancels_the_call_of_triton() -> None:
    triton = StandIn(served=["rfm"])
    with listening(triton) as gateway:
        leaving = [post_body(gateway, progress(FIRST)) for _ in range(3)]
        wait_for(lambda: gateway.metric("requests_in_flight") == len(leaving))
        for caller in leaving:
            caller.close()
        wait_for(lambda: gateway.metric("requests_total", code="499") == len(leaving))
        assert triton.num_cancelled == len(leaving)
        assert gateway.metric("requests_in_flight") == 0


def test_more_evaluations_than_allowed_are_a_503_and_no_score_in_time_is_a_504(
    triton: StandIn, strict: Address
) -> None:
    triton.is_open.clear()
    callers = [post_body(strict, progress(FIRST)) for _ in range(2)]
    wait_for(lambda: strict.metric("requests_in_flight") == 2)
    response = ask_json(strict, [progress(FIRST)])
    assert failure(response, 503) == "expected at most 2 evaluations at a time, got more"
    assert response.headers["Retry-After"] == "1"
    for caller in callers:
        answer = caller.getresponse()
        assert (answer.status, json.loads(answer.read())["detail"]) == (504, "Triton: no answer within 0.5 s")
        caller.close()
    wait_for(lambda: strict.metric("requests_in_flight") == 0)
    triton.is_open.set()
    assert answered(ask_json(strict, [progress(FIRST)]))


@pytest.mark.slow
def test_callers_who_wait_too_long_are_a_503_and_those_without_the_key_do_not_wait() -> None:
    triton, sent = StandIn(served=["rfm"]), {"content": dumped(progress(FIRST)), "headers": {"X-API-Key": KEY}}
    with inside(KEY, triton, timeout_s=1, max_in_flight=1) as client, ThreadPoolExecutor() as pool:
        asked = [pool.submit(client.post, "/evaluate_batch", **sent) for _ in range(2)]
        wait_for(lambda: "requests_waiting 1.0" in client.get("/metrics", headers=sent["headers"]).text)
        assert failure(client.post("/evaluate_batch", content=b"[]"), 401) == NO_KEY
        assert {each.result().status_code for each in asked} <= {503, 504}


def test_more_callers_than_are_scored_at_a_time_are_all_answered() -> None:
    """Upstream's clients do not ask again."""
    triton = StandIn(served=["rfm"])
    with listening(triton, max_in_flight=40) as gateway:
        callers = [post_body(gateway, progress(FIRST)) for _ in range(60)]
        wait_for(lambda: gateway.metric("requests_waiting") == 60 - 40)
        assert gateway.metric("requests_in_flight") == 40
        triton.is_open.set()
        for caller in callers:
            response = caller.getresponse()
            assert response.status == 200
            assert json.loads(response.read()).items() >= SCORED.items()
            caller.close()


def test_bodies_share_the_memory_of_eight_of_the_largest() -> None:
    with listening(StandIn(served=["rfm"]), max_body_mib=1) as gateway:
        slow = [begun(gateway, {"Content-Length": f"{MIB}"}, b" " * (MIB - 1)) for _ in range(8)]
        wait_for(lambda: ask_json(gateway, [NOTHING]).status_code == 503)
        response = ask_json(gateway, [NOTHING])
        assert failure(response, 503) == "body: expected at most 8 MiB of bodies at a time, got more; try again"
        assert response.headers["Retry-After"] == "1"
        for caller in slow:
            caller.close()
        wait_for(lambda: ask_json(gateway, [NOTHING]).status_code == 422)


@pytest.mark.parametrize("is_announced", [True, False], ids=["announced", "chunked"])
def test_arrays_are_views_of_the_form_that_they_come_in(*, is_announced: bool) -> None:
    arrays: list[Any] = [np.arange(3, dtype=np.uint8), *(np.arange(number, dtype=np.float64) for number in (1, 20_000))]
    files = [(f"{number}", ("a.npy", npy(array))) for number, array in enumerate(arrays)]  # odd sizes first
    body: Any = requests.Request("POST", "http://x", files=files).prepare().body
    form = Form(len(body) if is_announced else 0)
    parser = form.parser(body[2:].partition(b"\r\n")[0])
    for start in range(0, len(body), 1000):
        parser.write(body[start : start + 1000])
    _, uploads = form.parts()
    for upload, array in zip(uploads.values(), arrays, strict=True):
        read = _read_npy(upload.content)
        np.testing.assert_array_equal(read, array)
        assert np.shares_memory(read, upload.content)


POST = b"POST /evaluate_batch HTTP/1.1\r\nHost: localhost\r\n"
CHUNKED = POST + b"Transfer-Encoding: chunked\r\n\r\n2\r\n[]\r\n"
ENDLESS = {
    "trailers": CHUNKED + b"0\r\n" + b"a: b\r\n" * 2**19,
    "an extension of a chunk": CHUNKED + b"1;" + b"a" * 2**21,
    "a header": POST + b"x: " + b"a" * 2**21,
    "headers": POST + b"a: b\r\n" * 2**19,
}


@pytest.mark.parametrize("sent", ENDLESS.values(), ids=ENDLESS)
def test_endless_headers_trailers_and_chunk_extensions_are_cut_off(strict: Address, sent: bytes) -> None:
    with strict.dial() as peer, suppress(ConnectionError):
        peer.sendall(sent)
        while peer.recv(65536):
            pass


LARGE = b" " * 2**24  # more than the buffers of a connection hold


@pytest.fixture(scope="module")
def locked(triton: StandIn) -> Iterator[Address]:
    with listening(triton, KEY, max_body_mib=1) as started:
        yield started


def by_urllib(url: str, headers: dict[str, str]) -> int:
    """Asks with ``Connection: close``, and reads the answer after the whole body."""
    with pytest.raises(urllib.error.HTTPError) as refusal:
        urllib.request.urlopen(urllib.request.Request(url, LARGE, headers))
    with refusal.value as answer:
        return answer.code


CLOSE = {"Connection": "close"}
BY_PYTHON: dict[str, Callable[[str, dict[str, str]], int]] = {
    "urllib": by_urllib,
    "requests": lambda url, headers: requests.post(url, LARGE, headers=headers | CLOSE).status_code,
    "httpx": lambda url, headers: httpx.post(url, content=LARGE, headers=headers | CLOSE).status_code,
}
REFUSED = {401: {}, 413: {"X-API-Key": KEY}}  # before the body is read


@pytest.mark.parametrize("post", BY_PYTHON.values(), ids=BY_PYTHON)
def test_a_caller_who_sends_all_before_it_reads_gets_the_refusal(
    locked: Address, post: Callable[[str, dict[str, str]], int]
) -> None:
    for code, headers in REFUSED.items():
        assert post(f"{locked.url}/evaluate_batch", headers) == code


BY_NODE = """
const [url, headers, file] = process.argv.slice(1);
const options = { method: "POST", headers: JSON.parse(headers), agent: false };
const request = require("http").request(url, options, ({ statusCode }) => {
  process.stdout.write(`${statusCode}`);
  request.destroy();
});
request.end(require("fs").readFileSync(file));
"""


def test_node_and_curl_get_the_refusal(locked: Address, curl: str, node: str, tmp_path: Path) -> None:
    (tmp_path / "body").write_bytes(LARGE)
    url, file = f"{locked.url}/evaluate_batch", str(tmp_path / "body")
    by_curl = [curl, "-sS", "-o", "/dev/null", "-w", "%{http_code}", "--data-binary", f"@{file}", "-H", "Expect:", url]
    for code, headers in REFUSED.items():
        words = [word for name, value in headers.items() for word in ("-H", f"{name}: {value}")]
        by_node = [node, "-e", BY_NODE, url, json.dumps(headers | CLOSE), file]
        for command in (by_node, [*by_curl, *words], [*by_curl, *words, "--http1.0"]):
            assert subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout == b"%d" % code


UPGRADES = {
    "a JDK's or curl's HTTP/2": b"Connection: Upgrade, HTTP2-Settings\r\nUpgrade: h2c\r\nHTTP2-Settings: AAEAAEAA\r\n",
    "a websocket": b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n",
}


@pytest.mark.parametrize("headers", UPGRADES.values(), ids=UPGRADES)
def test_a_request_for_another_protocol_is_an_ordinary_request_with_its_body(strict: Address, headers: bytes) -> None:
    body = dumped(progress(FIRST)).encode()
    with strict.dial() as peer:
        peer.sendall(POST + headers + b"Content-Length: %d\r\n\r\n" % len(body) + body)
        head, _, answer = peer.recv(65536).partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 200 ")
        assert json.loads(answer or peer.recv(65536)).items() >= SCORED.items()


def test_a_program_that_names_no_host_is_answered(strict: Address) -> None:
    with strict.dial() as caller:
        caller.sendall(b"GET /metrics HTTP/1.0\r\n\r\n")
        assert caller.makefile("rb").readline().split()[1] == b"200"
