# SPDX-License-Identifier: MIT
"""The log tells of every request that is refused or fails: many callers never show why. No Triton is needed."""

from __future__ import annotations

import logging
from typing import Any

import pytest
from starlette.responses import JSONResponse

from gateway_requests import FIRST, NO_KEY, dumped, of_frames, progress
from gateways import TestClient, inside
from rfm_client.contract.process_log import LogLines
from rfm_gateway.limited_log import PERIOD_S
from rfm_gateway.refusals import MOST_LINES, RefusalLog

KEY = "open sesame"
WITH_KEY = {"X-API-Key": KEY}
FAULTY = dumped([progress(FIRST), progress({"task": 5}), of_frames("a")])
REFUSED: dict[str, tuple[str, str, dict[str, Any], str]] = {
    "the first of two faults": (
        "POST",
        "/evaluate_batch",
        {"content": FAULTY, "headers": WITH_KEY},
        "422 POST /evaluate_batch for testclient (testclient): 1.trajectory.task: expected text, got 5 (and 1 more)",
    ),
    "a whole body": (
        "POST",
        "/evaluate_batch_npy",
        {"headers": {**WITH_KEY, "User-Agent": "REALM/1"}},
        "415 POST /evaluate_batch_npy for testclient (REALM/1): content-type: expected multipart/form-data with a "
        "boundary, got none",
    ),
    "no key": ("GET", "/model_info", {}, f"401 GET /model_info for testclient (testclient): {NO_KEY}"),
    "a foreign page": (
        "GET",
        "/health",
        {"headers": {"Origin": "http://lab.example"}},
        "403 GET /health for testclient (testclient): origin: expected the gateway's own, got 'http://lab.example'; "
        "start the gateway with --cors-origin (rfm serve: --gateway-cors-origin) to allow it",
    ),
    "an unknown path": ("GET", "/x?key=1", {}, "404 GET /x for testclient (testclient): Not Found"),
}


@pytest.mark.parametrize(("method", "path", "options", "line"), REFUSED.values(), ids=REFUSED)
def test_a_refusal_is_a_line_with_status_caller_reason_and_request_id(
    caplog: pytest.LogCaptureFixture, method: str, path: str, options: dict[str, Any], line: str
) -> None:
    caplog.handler.setFormatter(LogLines("rfm-gateway"))
    with inside(KEY) as client:
        response = client.request(method, path, **options)
    (told,) = [each for each in caplog.text.splitlines() if "rfm-gateway" in each and "testclient" in each]
    head, _, message = told.partition(": ")
    assert message == line
    assert head.endswith(f"request={response.headers['X-Request-ID']}")
    assert " WARNING " in head


def test_what_triton_fails_is_a_line(caplog: pytest.LogCaptureFixture) -> None:
    with inside() as client:
        assert client.post("/evaluate_batch", content=dumped(progress(FIRST))).status_code == 503
    (told,) = [record.getMessage() for record in caplog.records if record.name == "rfm_gateway.refusals"]
    assert told.startswith("503 POST /evaluate_batch for testclient (testclient): ")
    assert "connect" in told


def test_many_refusals_do_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    now_s = [0.0]
    client = TestClient(RefusalLog(JSONResponse({"detail": "no"}, 400), clock_s=lambda: now_s[0]))
    caplog.set_level(logging.WARNING)
    for _ in range(MOST_LINES + 7):
        client.get("/")
    one = "400 GET / for testclient (testclient): no"
    assert caplog.messages == [one] * MOST_LINES
    now_s[0] += PERIOD_S
    client.get("/")
    assert caplog.messages[MOST_LINES:] == ["7 more requests were refused or failed", one]
    now_s[0] += PERIOD_S
    client.get("/")
    assert caplog.messages[MOST_LINES + 2 :] == [one]


def test_answers_are_no_lines(caplog: pytest.LogCaptureFixture) -> None:
    with inside() as client:
        assert client.get("/docs").status_code == 200
    assert [record for record in caplog.records if record.name == "rfm_gateway.refusals"] == []
