# SPDX-License-Identifier: MIT
"""Who may ask: keys, hosts, origins, and the lines about those who may not. No Triton is needed."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from gateway_requests import FIRST, NO_KEY, dumped, failure, of_frames, progress
from gateways import TestClient, inside
from rfm_client.contract.process import LogLines
from rfm_client.options import ConfigError
from rfm_gateway import GatewayConfig
from shown_datasets import copied

KEY, LAB, OWN = "open sesame", "http://lab.example", "http://127.0.0.1"
NPY, SAMPLE = "/evaluate_batch_npy", dumped(progress(FIRST))
OPEN = ("/", "/docs", "/openapi.json", "/viewer/main.js")
GUARDED = ("/gpu_status", "/model_info", "/metrics", "/viewer/served", "/viewer/datasets", "/viewer/datasets/0")
POSTS = ("/evaluate_batch", NPY, "/viewer/score", "/viewer/compare")
GETS = (*OPEN, "/metrics", "/viewer/datasets")


@pytest.fixture(scope="module")
def gateway() -> Iterator[TestClient]:
    with inside() as client:
        yield client


@pytest.fixture(scope="module")
def locked() -> Iterator[TestClient]:
    with inside(KEY, cors_origin=(LAB,)) as client:
        yield client


def coded(text: str) -> str:
    return base64.b64encode(text.encode()).decode()


KEYS: dict[str, tuple[dict[str, Any], bool]] = {
    "X-API-Key": ({"X-API-Key": KEY}, True),
    "by any name of the host": ({"X-API-Key": KEY, "Host": "evil.example.com"}, True),
    "Bearer": ({"Authorization": f"Bearer {KEY}"}, True),
    "none": ({}, False),
    "another": ({"X-API-Key": "sesame"}, False),
    "Basic": ({"Authorization": f"Basic {coded(f'any:{KEY}')}"}, True),
    "Basic without a user": ({"Authorization": f"basic {coded(f':{KEY}')}"}, True),
    "Basic, as the user": ({"Authorization": f"Basic {coded(f'{KEY}:')}"}, False),
    "Basic, another": ({"Authorization": f"Basic {coded('any:sesame')}"}, False),
    "Basic, not coded": ({"Authorization": f"Basic {KEY}"}, False),
    "Basic, no letters": ({"Authorization": b"Basic \xfc\xfc"}, False),
    "another scheme": ({"Authorization": f"Digest {coded(f'any:{KEY}')}"}, False),
    "no letters": ({"X-API-Key": b"\xfc"}, False),
}


@pytest.mark.parametrize(("headers", "is_right"), KEYS.values(), ids=KEYS)
def test_only_the_key_opens(locked: TestClient, headers: dict[str, Any], is_right: bool) -> None:
    answers = [locked.post(path, headers=headers) for path in POSTS]
    for response in (*answers, *(locked.get(path, headers=headers) for path in GUARDED)):
        assert (response.status_code != 401) is is_right, response.url
        if not is_right:
            assert failure(response, 401) == NO_KEY
            assert response.headers["WWW-Authenticate"] == "Bearer"  # for Basic, a browser would ask its user
    for path in OPEN:
        assert locked.get(path, headers=headers).status_code == 200


def test_the_key_is_that_of_the_file_or_else_of_the_variable(tmp_path: Path) -> None:
    (tmp_path / "key.txt").write_text(f"{KEY}\n")
    environment = {"RFM_GATEWAY_API_KEY": "another"}
    assert GatewayConfig(api_key_file=tmp_path / "key.txt").api_key(environment) == KEY
    config = GatewayConfig(triton_api_key_file=tmp_path / "key.txt")
    kept = config.credentials
    (tmp_path / "key.txt").unlink()  # requests read no file
    assert config.credentials is kept
    assert GatewayConfig().api_key(environment) == "another"
    assert GatewayConfig().api_key({}) is None


LOCAL = ("localhost", "LOCALHOST:8100", "localhost.", "page.localhost", "127.0.0.1:8100", "[::1]:8100")
ADDRESSES = ("10.0.0.5:8100", "192.168.1.7", "[fe80::1]:8100")  # which no DNS can change
OF_NETWORK = ("robot:8100", "robot.local", "robot.lan", "host.docker.internal", "rfm.robots.svc.cluster.local:80")
FOREIGN = ("evil.example.com", "evil.example.com:8100", "rfm.robots", "127.0.0.1.evil.example", "[::1", "")


HOSTS: dict[str, tuple[Any, Sequence[str], Sequence[str]]] = {  # settings, and hosts that are answered and refused
    "on this machine": ({}, (*LOCAL, *ADDRESSES), (*FOREIGN, *OF_NETWORK)),
    "on all addresses": (
        {"host": "0.0.0.0", "allow_host": ("GPU.lab.example", "box.lab.example.")},
        (*LOCAL, *ADDRESSES, *OF_NETWORK, "gpu.lab.example:8100", "box.lab.example"),
        (*FOREIGN, "other.lab.example"),
    ),
    "on a name": ({"host": "robot.lab.example"}, ("robot.lab.example:8100",), FOREIGN),
}


@pytest.mark.parametrize(("settings", "answered", "refused"), HOSTS.values(), ids=HOSTS)
def test_a_name_that_anybody_could_own_gets_nothing_without_a_key(
    settings: Any, answered: Sequence[str], refused: Sequence[str]
) -> None:
    known = "a local name" if settings else "localhost"
    with inside(**settings) as client:
        for host in refused:
            for path in GETS:
                assert failure(client.get(path, headers={"Host": host}), 421) == (
                    f"host: expected {known} or an IP address, got {host!r}; start the gateway with a key, or name this "
                    "host: --allow-host (rfm serve: --gateway-allow-host)"
                )
        for host in answered:
            assert client.get("/metrics", headers={"Host": host}).status_code == 200, host


@pytest.mark.parametrize(
    ("setting", "names", "expected"),
    [
        ("allow_host", ("http://robot", "robot:8100", "a b", ""), "a host name without scheme and port"),
        ("cors_origin", ("http://lab.example/", "https://Lab.example", "lab.example", "null", ""), "* or an origin in"),
    ],
)
def test_names_to_allow_are_those_that_browsers_send(setting: str, names: tuple[str, ...], expected: str) -> None:
    for name in names:
        with pytest.raises(ConfigError, match=rf"{re.escape(expected)}.*, got {name!r}"):
            GatewayConfig(**{setting: (name,)})


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


@pytest.mark.parametrize("headers", OF_OTHERS.values(), ids=OF_OTHERS)
def test_a_page_of_another_origin_gets_nothing(
    gateway: TestClient, locked: TestClient, headers: dict[str, str]
) -> None:
    got = f"origin: expected the gateway's own, got {headers.get('Origin', 'none, of another site')!r}; "
    remedy = "start the gateway with --cors-origin (rfm serve: --gateway-cors-origin) to allow it"
    for path in POSTS:
        for kind in ("text/plain", "application/json"):
            response = gateway.post(path, content=SAMPLE, headers={"Content-Type": kind, **headers})
            assert failure(response, 403) == got + remedy
    for path in GETS:
        assert gateway.get(path, headers=headers).status_code == 403
    response = locked.post("/evaluate_batch", content=SAMPLE, headers={"X-API-Key": KEY, **headers})
    assert failure(response, 403) == got + remedy


@pytest.mark.parametrize("headers", OF_OURS.values(), ids=OF_OURS)
def test_the_page_and_programs_are_answered(gateway: TestClient, headers: dict[str, str]) -> None:
    for path in POSTS:
        assert gateway.post(path, content=b"", headers=headers).status_code in (415, 422)  # like a wrong body
    for path in GETS:
        assert gateway.get(path, headers=headers).status_code == 200


def test_a_link_elsewhere_opens_the_page_and_a_form_elsewhere_posts_nothing(gateway: TestClient) -> None:
    link = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}
    assert gateway.get("/", headers=link).status_code == 200
    assert gateway.post("/evaluate_batch", content=b"", headers=link).status_code == 403


def test_browsers_that_tell_no_site_embed_pictures_and_videos_of_ours_in_our_page_alone(tmp_path: Path) -> None:
    with inside(dataset=(str(copied("toy_v30_many", tmp_path)),)) as client:
        for path in ("/", "/health", "/viewer/datasets", "/viewer/datasets/0/episodes/0/videos/0"):
            headers = client.get(path).headers
            assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
            assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]


@pytest.mark.parametrize("allowed", [LAB, "*"])
def test_an_allowed_origin_may_ask_and_no_other(locked: TestClient, gateway: TestClient, allowed: str) -> None:
    name, site = "Access-Control-Allow-Origin", {"Origin": LAB, "Sec-Fetch-Site": "cross-site"}
    with inside(cors_origin=(allowed,)) as client:
        response = client.post("/evaluate_batch", content=b"[]", headers=site)
        assert (response.status_code, response.headers[name]) == (422, allowed)
        other = client.post("/evaluate_batch", content=b"[]", headers={**site, "Origin": "http://other.example"})
        assert (other.status_code == 403) is (allowed != "*")
    preflight = {"Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "x-api-key"}
    response = locked.options("/evaluate_batch", headers=preflight | {"Origin": LAB})
    assert (response.status_code, response.headers[name]) == (200, LAB)
    assert name not in locked.options("/evaluate_batch", headers=preflight | {"Origin": "http://other"}).headers
    assert name not in gateway.get("/health", headers={"Origin": LAB}).headers


FAULTY = dumped([progress(FIRST), progress({"task": 5}), of_frames("a")])


def test_a_refusal_is_a_line_with_status_caller_reason_and_request_id(caplog: pytest.LogCaptureFixture) -> None:
    caplog.handler.setFormatter(LogLines("rfm-gateway"))
    with inside() as client:
        faulty = client.post("/evaluate_batch", content=FAULTY)
        unknown = client.get("/x?key=1", headers={"User-Agent": "REALM/1"})
        assert client.get("/docs").status_code == 200  # no line
    lines = [each for each in caplog.text.splitlines() if "rfm-gateway" in each and "for testclient" in each]
    told = [
        "422 POST /evaluate_batch for testclient (testclient): 1.trajectory.task: expected text, got 5 (and 1 more)",
        "404 GET /x for testclient (REALM/1): Not Found",
    ]
    for line, response, message in zip(lines, (faulty, unknown), told, strict=True):
        head, _, found = line.partition(": ")
        assert found == message
        assert head.endswith(f"request={response.headers['X-Request-ID']}")
        assert " WARNING " in head


def test_a_failure_of_triton_is_logged_and_refused_evaluations_are_counted_with_their_id(
    caplog: pytest.LogCaptureFixture,
) -> None:
    refused = {503: {}, 421: {"Host": FOREIGN[0]}, 403: {"Origin": LAB}}
    with inside() as client:
        for headers in refused.values():
            response = client.post("/evaluate_batch", content=SAMPLE, headers={"X-Request-ID": "mine", **headers})
            assert response.headers["X-Request-ID"] == "mine"
        for code in refused:
            counted = f'rfm_gateway_requests_total{{code="{code}",endpoint="/evaluate_batch"}} 1.0'
            assert counted in client.get("/metrics").text
    found, *_ = [record.getMessage() for record in caplog.records if record.name == "rfm_gateway.refusals"]
    assert found.startswith("503 POST /evaluate_batch for testclient (testclient): ")
    assert "connect" in found


@pytest.mark.parametrize("path", ["/health", "/gpu_status", "/model_info", "/viewer/served", "/evaluate_batch"])
def test_a_triton_that_is_down_is_a_503(gateway: TestClient, path: str) -> None:
    response = gateway.get(path) if path != "/evaluate_batch" else gateway.post(path, content=SAMPLE)
    assert "connect" in failure(response, 503)
    assert response.headers["Retry-After"] == "1"
