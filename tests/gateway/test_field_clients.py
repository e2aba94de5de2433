# SPDX-License-Identifier: MIT
"""Public Robometer clients change their URL and nothing else."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest

import goldens
from field_clients import CHECKPOINT, CLIENTS, EVALUATIONS, REPORTS, FieldRequest, Scores
from gateway_requests import (
    FRAME_STEPS,
    answered,
    ask_json,
    expected,
)
from gateways import Gateway, running
from paths import ROOT
from servers import Served
from tolerances import TOLERANCE

pytestmark = [pytest.mark.triton, pytest.mark.slow]

QWEN3 = {"name": "model", "type": "Qwen3VLModel"}  # as a client of the original server looks for it
PROBABILITY = goldens.config(CHECKPOINT).tolerances[1]


@pytest.fixture(scope="module")
def gateway(served: Served, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
    served.has(CHECKPOINT)
    with running(served.endpoints, tmp_path_factory.mktemp("gateway"), CHECKPOINT) as started:
        yield started


@pytest.fixture(scope="module")
def changed(served: Served, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
    """A gateway that scores by prefixes unless a request says otherwise."""
    served.has(CHECKPOINT)
    folder = tmp_path_factory.mktemp("changed")
    with running(served.endpoints, folder, CHECKPOINT, "--use-frame-steps", "--no-viewer") as started:
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
    answer = json.loads(body)
    assert set(request_.expected["keys"]) <= answer.keys()
    if "model_architecture" in answer:
        assert answer["model_architecture"]["model_module"] == "rfm.families.robometer.network"
        assert answer["model_architecture"]["architecture_summary"][1].items() >= QWEN3.items()


NAMED = {str(request): request for request in EVALUATIONS}


def test_a_request_that_does_not_say_is_scored_by_prefixes_where_the_gateway_has_that_default(changed: Gateway) -> None:
    silent, saying_false = NAMED["rynnvalue_pirl.default"], NAMED["openpi_monitor.default"]
    samples = silent.samples()
    steps = Scores.of(expected(changed, samples, frame_steps=FRAME_STEPS))
    assert steps.difference(silent.original) > 0.1  # as one pass
    scores = Scores.of(json.loads(silent.sent(changed.url)[2]))
    assert scores.difference(steps) <= TOLERANCE
    scores = Scores.of(answered(ask_json(changed, samples, use_frame_steps=None)))
    assert scores.difference(steps) <= TOLERANCE
    scores = Scores.of(json.loads(saying_false.sent(changed.url)[2]))
    assert scores.difference(saying_false.original) <= PROBABILITY


def test_the_guide_names_each_project_whose_requests_are_sent_and_the_longest_that_it_waits() -> None:
    guide = (ROOT / "docs" / "guides" / "robometer_clients.md").read_text()
    rows = {row.split(" | ")[0].removeprefix("| "): row for row in guide.splitlines() if row.startswith("| ")}
    for client in CLIENTS.values():
        if client["project"] != "unknown":
            assert f"{client['timeout_s']} s" in rows[client["project"]]
