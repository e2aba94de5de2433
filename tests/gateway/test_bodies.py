# SPDX-License-Identifier: MIT
"""The gateway refuses wrong keys, origins and bodies before it asks Triton. No Triton is needed."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Iterator
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
import requests

from gateway_requests import FIRST, MULTIPART, NAMED, NO_KEY, check_refused, dumped, failure, npy, npy_of, progress
from gateways import TestClient, inside

KEY, ORIGIN = "open sesame", "http://lab.example"
NPY = "/evaluate_batch_npy"
SAMPLE = dumped(progress(FIRST))


@pytest.fixture(scope="module")
def gateway() -> Iterator[TestClient]:
    with inside(max_body_mib=1) as client:
        yield client


NO_SAMPLE, NO_STEPS = "expected at least one sample, got none", "expected true or false, got "
BODIES: dict[str, tuple[bytes, list[Any], str]] = {
    "half an object": (b'{"samples": [', [], "expected JSON, got: .*"),
    "no UTF-8": (b'["\xff"]', [], "expected JSON, got: .*"),
    "ten thousand brackets": (b"[" * 10_000, [], "expected JSON, got: recursion limit .*"),
    "an empty list": (b"[]", ["samples"], NO_SAMPLE),
    "an empty object": (b"{}", ["samples"], NO_SAMPLE),
    "a number": (b"5", [], "expected a list of samples, got int"),
    "samples as an object": (b'{"samples": {}}', ["samples"], "expected a list of samples, got dict"),
    "too many": (b"[%b5]" % (b"5," * 10_000), ["samples"], "expected at most 10000 samples, got 10001"),
    "very many errors": (b"[%b5]" % (b"5," * 2000), [], "expected no faulty fields, got 2001"),
    "a list of numbers": (b"[5]", [0], "expected an object, got 5"),
    "a sample without a type": (b'{"sample_type": null}', ["sample_type"], "expected progress, .*, got None"),
    "a list by another name": (b'{"batch": [5]}', ["batch", 0], "expected an object, got 5"),
    "an object of samples": (b'{"a": %b, "b": 6}' % SAMPLE.encode(), ["b"], "expected an object, got 6"),
    "no steps": (b'{"samples": [5], "use_frame_steps": 2}', ["use_frame_steps"], f"{NO_STEPS}2"),
}


@pytest.mark.parametrize(("body", "path", "message"), BODIES.values(), ids=BODIES)
def test_a_body_that_holds_no_samples_is_refused(
    gateway: TestClient, body: bytes, path: list[Any], message: str
) -> None:
    check_refused(gateway.post("/evaluate_batch", content=body), (path, message))


VIDEO_AT = ["sample_0", "trajectory", "video_embeddings"]
HUGE = "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000000, 2)}"
NO_NPY = r"expected a \.npy file, got: .*"
FILES = {
    "truncated": (npy(np.ones((3, 2)))[:-4], NO_NPY),
    "too long": (npy(np.ones((3, 2))) + b"1", r"expected a \.npy file of 48 bytes behind its header, got more"),
    "a shape of petabytes": (npy_of(HUGE), NO_NPY),
    "pickled": (npy(np.array([[1, {}]], object), pickled=True), NO_NPY),
    "text": (npy(np.array([["a", "b"]])), r"expected a \.npy file of numbers, got <U1"),
    "complex": (npy(np.ones((3, 2), complex)), r"expected a \.npy file of numbers, got complex128"),
    "no .npy file": (b"hello world", NO_NPY),
    "an unbalanced header": (npy_of("{'descr': '<f4', ("), NO_NPY),
    "a type of nothing": (npy_of(HUGE.replace("'<f4'", "()")), NO_NPY),
    "an endless header": (npy_of("-" * 20_000), NO_NPY),
}


@pytest.mark.parametrize(("file", "message"), FILES.values(), ids=FILES)
def test_a_bad_npy_file_is_refused_at_its_field(gateway: TestClient, file: bytes, message: str) -> None:
    form = {"sample_0": json.dumps(progress({"video_embeddings": {"__numpy_file__": "video"}}))}
    check_refused(gateway.post(NPY, data=form, files={"video": ("video.npy", file)}), (VIDEO_AT, message))


ZERO = ("sample_0", (None, SAMPLE))
MISSING = dumped(progress({**FIRST, "video_embeddings": {"__numpy_file__": "other"}}))
TWICE, NO_FILE = "expected one part of this name, got several", "expected a form field, got a file"
FORMS: dict[str, tuple[list[tuple[str, Any]], list[Any], str]] = {
    "no sample": ([("use_frame_steps", (None, "true"))], ["samples"], NO_SAMPLE),
    "a gap": ([ZERO, ("sample_2", ZERO[1])], ["sample_1"], "expected a sample, got none, but sample_2"),
    "another spelling": ([("sample_01", ZERO[1])], ["sample_01"], "expected sample_0, sample_1 and so on, got .*"),
    "other steps": ([ZERO, ("use_frame_steps", (None, "yes"))], ["use_frame_steps"], f"{NO_STEPS}'yes'"),
    "no JSON": ([("sample_0", (None, "{"))], ["sample_0"], "expected JSON, got: .*"),
    "JSON in JSON": ([("sample_0", (None, '"{}"'))], ["sample_0"], "expected an object, got '{}'"),
    "no part": ([("sample_0", (None, MISSING))], VIDEO_AT, r"expected a \.npy part named 'other', got none"),
    "one field twice": ([ZERO] * 2, ["sample_0"], TWICE),
    "one file twice": ([ZERO, *[("a", ("a.npy", b""))] * 2], ["a"], TWICE),
    "a sample as a file": ([("sample_0", ("sample_0", b"{}"))], ["sample_0"], NO_FILE),
    "steps as a file": ([ZERO, ("use_frame_steps", ("steps", b"true"))], ["use_frame_steps"], NO_FILE),
}


@pytest.mark.parametrize(("parts", "path", "message"), FORMS.values(), ids=FORMS)
def test_no_part_of_a_form_is_lost_silently(
    gateway: TestClient, parts: list[tuple[str, Any]], path: list[Any], message: str
) -> None:
    check_refused(gateway.post(NPY, files=parts), (path, message))


NAMELESS = b"--b\r\nContent-Disposition: form-data\r\n\r\nx\r\n--b--\r\n"
NO_FORM = "content-type: expected multipart/form-data with a boundary, got"
NO_PARTS, NO_END = "body: expected multipart/form-data, got: ", "body: expected its last boundary"
NO_CHARSET = "content-type: expected the charset utf-8, got "
WHOLE = NAMED + SAMPLE.encode() + b"\r\n"
UNREADABLE: dict[str, tuple[int, str, str, bytes]] = {
    "JSON": (415, f"{NO_FORM} application/json", "application/json", b"[]"),
    "no content type": (415, f"{NO_FORM} none", "", b"[]"),
    "no boundary": (415, f"{NO_FORM} multipart/form-data", "multipart/form-data", NAMED),
    "no multipart": (400, NO_PARTS, MULTIPART, b"hello"),
    "no name": (400, NO_PARTS, MULTIPART, NAMELESS),
    **{
        f"charset {name}": (415, f"{NO_CHARSET}'{name}'", f"{MULTIPART}; charset={name}", WHOLE + b"--b--\r\n")
        for name in ("undefined", "unicode_escape", "idna", "rot13", "latin-1")
    },
    "nothing": (400, NO_END, MULTIPART, b""),
    "cut off": (400, NO_END, MULTIPART, WHOLE + NAMED + b"{"),
    "cut off in a boundary": (400, NO_END, MULTIPART, WHOLE + b"--"),
}


@pytest.mark.parametrize(("code", "message", "content_type", "body"), UNREADABLE.values(), ids=UNREADABLE)
def test_what_is_no_multipart_is_refused(
    gateway: TestClient, code: int, message: str, content_type: str, body: bytes
) -> None:
    assert failure(gateway.post(NPY, content=body, headers={"Content-Type": content_type}), code).startswith(message)


@pytest.mark.parametrize("path", ["/evaluate_batch", NPY, "/viewer/score"])
@pytest.mark.parametrize("content", [b" " * (2**20 + 1), [b" " * 2**19] * 3], ids=["announced", "in chunks"])
def test_too_large_a_body_is_a_413(gateway: TestClient, path: str, content: Any) -> None:
    is_form = path in (NPY, "/viewer/score")
    body = content if isinstance(content, bytes) else iter([NAMED, *content] if is_form else content)
    response = gateway.post(path, content=body, headers={"Content-Type": MULTIPART})
    remedy = "send less in one request, or start the gateway with --max-body-mib (rfm serve: --gateway-max-body-mib)"
    assert failure(response, 413) == f"body: expected at most 1048576 bytes, got more; {remedy}"


def test_too_many_parts_are_a_413(gateway: TestClient) -> None:
    files = [ZERO, *((f"array_{number}", (f"{number}.npy", b"")) for number in range(2000))]
    response = gateway.post(NPY, files=files)
    expected = "body: expected at most 2000 parts, fields and files together, got more"
    assert failure(response, 413) == f"{expected}; send the samples in several requests"
    assert gateway.post(NPY, files=files[:-1]).status_code == 503  # there is no Triton


def test_json_is_smaller_than_other_bodies() -> None:
    with inside() as client:
        response = client.post("/evaluate_batch", content=b" " * (32 * 2**20 + 1))
        remedy = "send arrays as .npy files, to /evaluate_batch_npy"
        assert failure(response, 413) == f"body: expected at most 33554432 bytes, got more; {remedy}"


@pytest.mark.parametrize("path", ["/evaluate_batch", NPY])
def test_a_compressed_body_is_told_from_broken_json(gateway: TestClient, path: str) -> None:
    headers = {"Content-Type": MULTIPART, "Content-Encoding": "gzip"}
    response = gateway.post(path, content=gzip.compress(SAMPLE.encode()), headers=headers)
    expected = "content-encoding: expected none, since the gateway unpacks no body, got 'gzip'; send the body as it is"
    assert failure(response, 415) == expected


@pytest.mark.parametrize("path", ["/health", "/gpu_status", "/model_info", "/viewer/served", "/evaluate_batch"])
def test_a_triton_that_is_down_is_a_503(gateway: TestClient, path: str) -> None:
    response = gateway.get(path) if path != "/evaluate_batch" else gateway.post(path, content=SAMPLE)
    assert "connect" in failure(response, 503)
    assert response.headers["Retry-After"] == "1"


def test_unknown_paths_and_methods_are_told_as_json(gateway: TestClient) -> None:
    assert failure(gateway.post("/evaluate"), 404) == "Not Found"
    assert failure(gateway.get("/evaluate_batch"), 405) == "Method Not Allowed"


# Who may ask


def coded(text: str) -> str:
    return base64.b64encode(text.encode()).decode()


KEYS: dict[str, tuple[dict[str, Any], bool]] = {
    "X-API-Key": ({"X-API-Key": KEY}, True),
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
EPISODE = "/viewer/datasets/0/episodes/0"
GUARDED = {
    "POST": ("/evaluate_batch", NPY, "/viewer/score", "/viewer/compare"),
    "GET": (
        *("/gpu_status", "/model_info", "/metrics", "/viewer/served", "/viewer/datasets", "/viewer/datasets/0"),
        *(EPISODE, f"{EPISODE}/videos/0"),
    ),
}


def test_only_the_key_opens() -> None:
    with inside(KEY) as client:
        asked = [(method, path, *key) for method, paths in GUARDED.items() for path in paths for key in KEYS.values()]
        for method, path, headers, is_right in asked:
            response = client.request(method, path, headers=headers)
            assert (response.status_code != 401) is is_right, path
            if not is_right:
                assert failure(response, 401) == NO_KEY
                assert response.headers["WWW-Authenticate"] == "Bearer"  # for Basic, a browser would ask its user
        for path in ("/", "/docs", "/openapi.json", "/viewer/main.js"):
            assert client.get(path).status_code == 200
        assert client.get("/health").status_code == 503  # there is no Triton


def test_the_key_may_be_the_password_in_the_url_of_httpx_and_requests() -> None:
    url = f"http://any:{quote(KEY)}@127.0.0.1/metrics"
    with inside(KEY) as client:
        assert client.get(url).status_code == 200
        assert client.get("/metrics", headers=requests.Request("GET", url).prepare().headers).status_code == 200
        assert client.get("http://any@127.0.0.1/metrics").status_code == 401


def test_browsers_may_ask_from_the_named_origin_alone(gateway: TestClient) -> None:
    allowed = "Access-Control-Allow-Origin"
    preflight = {"Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "x-api-key"}
    with inside(KEY, cors_origin=(ORIGIN,)) as client:
        response = client.options("/evaluate_batch", headers=preflight | {"Origin": ORIGIN})
        assert (response.status_code, response.headers[allowed]) == (200, ORIGIN)
        response = client.post("/evaluate_batch", content=SAMPLE, headers={"Origin": ORIGIN, "X-API-Key": KEY})
        assert response.headers[allowed] == ORIGIN
        other = {"Origin": "http://other.example"}
        assert allowed not in client.options("/evaluate_batch", headers=preflight | other).headers
        assert allowed not in client.get("/health", headers=other).headers
    assert allowed not in gateway.get("/health", headers={"Origin": ORIGIN}).headers


def test_the_schemas_are_those_of_the_evaluation_server_and_not_the_pages(gateway: TestClient) -> None:
    document = gateway.get("/openapi.json").json()
    names = ("evaluate_batch", "evaluate_batch_npy", "gpu_status", "health", "model_info", "metrics")
    assert document["paths"].keys() == {f"/{name}" for name in names}
    codes = document["paths"]["/evaluate_batch"]["post"]["responses"].keys()
    assert codes == {"200", "408", "413", "415", "422", "502", "503", "504"}
