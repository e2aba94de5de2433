# SPDX-License-Identifier: MIT
"""Public Robometer clients change their URL and nothing else."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest

import goldens
from field_clients import CHECKPOINT, EVALUATIONS, REPORTS, FieldRequest, Scores
from gateway_requests import FRAME_STEPS, expected
from gateways import Gateway, running
from servers import Served
from tolerances import TOLERANCE

pytestmark = pytest.mark.triton

PROBABILITY = goldens.config(CHECKPOINT).tolerances[1]


@pytest.fixture(scope="module")
def gateway(served: Served, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
    with running(served.endpoints, tmp_path_factory.mktemp("gateway"), CHECKPOINT) as started:
        yield started


@pytest.mark.parametrize("request_", EVALUATIONS, ids=str)
def test_a_recorded_request_gets_the_original_servers_numbers_and_those_of_the_python_client(
    gateway: Gateway, request_: FieldRequest
) -> None:
    status, headers, body = request_.sent(gateway.url)
    assert (status, headers["content-type"]) == (200, "application/json"), body
    answer = json.loads(body, parse_constant=pytest.fail)
    for path in request_.expected["keys"]:
        outputs, key = path.split(".")
        assert isinstance(answer[outputs][key], list)
    scores = Scores.of(answer)
    lengths = request_.expected["lengths"]
    assert scores.lengths == (lengths, lengths, request_.expected["preferences"])
    assert scores.difference(request_.original) <= PROBABILITY
    steps = FRAME_STEPS if request_.expected["use_frame_steps"] else 0
    alone = [Scores.of(expected(gateway, [sample], frame_steps=steps)) for sample in request_.samples()]
    assert scores.difference(Scores.joined(alone)) <= TOLERANCE


@pytest.mark.parametrize("request_", REPORTS, ids=str)
def test_the_reports_that_clients_read_have_their_keys(gateway: Gateway, request_: FieldRequest) -> None:
    status, _, body = request_.sent(gateway.url)
    assert status == 200, body
    assert set(request_.expected["keys"]) <= json.loads(body).keys()
