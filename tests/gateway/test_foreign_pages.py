# SPDX-License-Identifier: MIT
"""The gateway answers known hosts and pages alone. No Triton is needed."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway_requests import FIRST, dumped, failure, progress
from gateways import TestClient, inside, running
from rfm_client.options import ConfigError
from rfm_gateway import GatewayConfig
from servers import Endpoints
from shown_datasets import copied

SAMPLE, KEY, LAB = dumped(progress(FIRST)), "open sesame", "http://lab.example"
OWN = "http://127.0.0.1"
GETS = ("/", "/docs", "/openapi.json", "/metrics", "/viewer/datasets", "/viewer/main.js")
POSTS = ("/evaluate_batch", "/evaluate_batch_npy", "/viewer/score", "/viewer/compare")


@pytest.fixture(scope="module")
def gateway() -> Iterator[TestClient]:
    with inside() as client:
        yield client


HOSTS_OF_LOOPBACK = ("localhost", "LOCALHOST:8100", "localhost.", "page.localhost", "127.0.0.1:8100", "[::1]:8100")
ADDRESSES = ("10.0.0.5:8100", "192.168.1.7", "[fe80::1]:8100")  # which no DNS can change
HOSTS_OF_NETWORK = (
    *("robot:8100", "gateway", "robot.local", "robot.lan", "host.docker.internal"),
    *("rfm.robots.svc", "rfm.robots.svc.cluster.local:80"),
)
FOREIGN_HOSTS = (
    "evil.example.com",
    "evil.example.com:8100",
    "rfm.robots",
    "127.0.0.1.evil.example",
    "localhost.evil.example",
    "[::1",
)


@pytest.mark.parametrize("path", GETS)
def test_a_name_that_anybody_could_own_gets_nothing_without_a_key(gateway: TestClient, path: str) -> None:
    for host in (*FOREIGN_HOSTS, *HOSTS_OF_NETWORK, ""):
        told = failure(gateway.get(path, headers={"Host": host}), 421)
        assert told == (
            f"host: expected localhost or an IP address, got {host!r}; start the gateway with a key, or name this host: "
            "--allow-host (rfm serve: --gateway-allow-host)"
        )
    for host in (*HOSTS_OF_LOOPBACK, *ADDRESSES):
        assert gateway.get(path, headers={"Host": host}).status_code == 200, host


def test_on_other_addresses_names_of_the_local_network_are_answered_too() -> None:
    with inside(host="0.0.0.0", allow_host=("GPU.lab.example", "box.lab.example.")) as client:
        for host in (*HOSTS_OF_LOOPBACK, *ADDRESSES, *HOSTS_OF_NETWORK, "gpu.lab.example:8100", "box.lab.example"):
            assert client.get("/viewer/datasets", headers={"Host": host}).status_code == 200, host
        for host in (*FOREIGN_HOSTS, "other.lab.example", ""):
            told = failure(client.get("/viewer/datasets", headers={"Host": host}), 421)
            assert told.startswith(f"host: expected a local name or an IP address, got {host!r}; ")
    with inside(host="robot.lab.example") as client:
        assert client.get("/viewer/datasets", headers={"Host": "robot.lab.example:8100"}).status_code == 200


def test_with_a_key_every_host_is_answered_and_the_key_alone_opens() -> None:
    with inside(KEY) as client:
        host = {"Host": FOREIGN_HOSTS[0]}
        assert client.get("/viewer/datasets", headers=host | {"X-API-Key": KEY}).status_code == 200
        assert client.get("/viewer/datasets", headers=host).status_code == 401


@pytest.mark.parametrize("name", ["http://robot", "robot:8100", "a b", ""])
def test_a_host_to_allow_is_a_name(name: str) -> None:
    with pytest.raises(ConfigError, match=f"expected a host name without scheme and port, got {name!r}"):
        GatewayConfig(allow_host=("robot", name))


@pytest.mark.parametrize("origin", ["http://lab.example/", "https://Lab.example", "lab.example", "null", ""])
def test_an_origin_to_allow_is_one_that_browsers_send(origin: str) -> None:
    with pytest.raises(ConfigError, match=f"cors_origin: expected .* without a path, .*, got {origin!r}"):
        GatewayConfig(cors_origin=(LAB, origin))


OF_OTHERS = {
    "another origin": {"Origin": "http://evil.example.com"},
    "another port": {"Origin": f"{OWN}:3000"},
    "no origin that it would name": {"Origin": "null"},
    "another site": {"Sec-Fetch-Site": "cross-site"},
    "another program of this machine": {"Sec-Fetch-Site": "same-site"},
    "another site with an origin like ours": {"Sec-Fetch-Site": "cross-site", "Origin": OWN},
    "a frame": {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "iframe"},
}
OF_OURS = {
    "no browser": {},
    "the page": {"Origin": OWN, "Sec-Fetch-Site": "same-origin"},
    "the page, in an old browser": {"Origin": OWN},
    "the page, behind a proxy with another host": {"Origin": "https://box.example", "Sec-Fetch-Site": "same-origin"},
    "an address that somebody typed": {"Sec-Fetch-Site": "none"},
}
A_LINK = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}


@pytest.mark.parametrize("headers", OF_OTHERS.values(), ids=OF_OTHERS)
def test_a_page_of_another_origin_gets_nothing(gateway: TestClient, headers: dict[str, str]) -> None:
    for path in POSTS:
        for kind in ("text/plain", "application/json"):
            told = failure(gateway.post(path, content=SAMPLE, headers={"Content-Type": kind, **headers}), 403)
            assert told.startswith("origin: expected the gateway's own, got ")
            assert told.endswith(
                "; start the gateway with --cors-origin (rfm serve: --gateway-cors-origin) to allow it"
            )
    for path in GETS:
        assert gateway.get(path, headers=headers).status_code == 403
    with inside(KEY) as client:
        told = failure(client.post("/evaluate_batch", content=SAMPLE, headers={"X-API-Key": KEY, **headers}), 403)
        assert repr(headers.get("Origin", "none, of another site")) in told


@pytest.mark.parametrize(
    ("reason", "headers"), [("origin", {"Origin": "http://evil.example.com"}), ("host", {"Host": "evil.example.com"})]
)
def test_refused_evaluations_are_counted_and_have_their_id(reason: str, headers: dict[str, str]) -> None:
    with inside() as client:
        response = client.post("/evaluate_batch", content=SAMPLE, headers={"X-Request-ID": "mine", **headers})
        assert response.headers["X-Request-ID"] == "mine"
        assert f'rfm_gateway_rejections_total{{reason="{reason}"}} 1.0' in client.get("/metrics").text


@pytest.mark.parametrize("headers", OF_OURS.values(), ids=OF_OURS)
def test_the_page_and_programs_are_answered(gateway: TestClient, headers: dict[str, str]) -> None:
    for path in POSTS:
        assert gateway.post(path, content=b"", headers=headers).status_code in (415, 422)  # like a wrong body
    for path in GETS:
        assert gateway.get(path, headers=headers).status_code == 200


def test_a_link_elsewhere_opens_the_page_and_a_form_elsewhere_posts_nothing(gateway: TestClient) -> None:
    assert gateway.get("/", headers=A_LINK).status_code == 200
    assert gateway.post("/evaluate_batch", content=b"", headers=A_LINK).status_code == 403


def test_browsers_that_tell_no_site_embed_pictures_and_videos_of_ours_in_our_page_alone(tmp_path: Path) -> None:
    with inside(dataset=(str(copied("toy_v30_many", tmp_path)),)) as client:
        for path in ("/", "/health", "/viewer/datasets", "/viewer/datasets/0/episodes/0/videos/0"):
            headers = client.get(path).headers
            assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
            assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]


@pytest.mark.parametrize("allowed", [LAB, "*"])
def test_an_allowed_origin_may_post(allowed: str) -> None:
    with inside(cors_origin=(allowed,)) as client:
        headers = {"Origin": LAB, "Sec-Fetch-Site": "cross-site"}
        response = client.post("/evaluate_batch", content=b"[]", headers=headers)
        assert (response.status_code, response.headers["Access-Control-Allow-Origin"]) == (422, allowed)
        other = client.post("/evaluate_batch", content=b"[]", headers={**headers, "Origin": "http://other.example"})
        assert (other.status_code == 403) is (allowed != "*")


def test_requests_without_a_host_are_of_programs(tmp_path: Path) -> None:
    with (
        running(Endpoints.free(), tmp_path) as gateway,
        socket.create_connection(("127.0.0.1", int(gateway.url.rpartition(":")[2]))) as caller,
    ):
        caller.sendall(b"GET /viewer/datasets HTTP/1.0\r\n\r\n")
        assert caller.makefile("rb").readline().split()[1] == b"200"
