# SPDX-License-Identifier: MIT
"""Public Robometer clients change their URL and nothing else."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import numpy as np
import pytest

import goldens
from field_clients import CHECKPOINT, CLIENTS, EVALUATIONS, REPORTS, FieldRequest, Scores
from gateway_requests import (
    FRAME_STEPS,
    Ask,
    answered,
    as_parts,
    ask_json,
    ask_npy,
    check_refused,
    expected,
    filmed,
    numbers,
    of_frames,
    preference,
    progress,
)
from gateways import Gateway, running
from paths import ROOT
from servers import Served
from tolerances import TOLERANCE

pytestmark = pytest.mark.triton

QWEN3 = {"name": "model", "type": "Qwen3VLModel"}  # as a client of the original server looks for it
PROBABILITY = goldens.config(CHECKPOINT).tolerances[1]


@pytest.fixture(scope="module")
def gateway(served: Served, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
    with running(served.endpoints, tmp_path_factory.mktemp("gateway"), CHECKPOINT) as started:
        yield started


@pytest.fixture(scope="module")
def changed(served: Served, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
    """A gateway that scores by prefixes unless a request says otherwise, and refuses frames that show nothing."""
    options = ("--use-frame-steps", "--refuse-blank", "--no-viewer")
    with running(served.endpoints, tmp_path_factory.mktemp("changed"), CHECKPOINT, *options) as started:
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
        assert answer["model_architecture"]["model_module"] == "rfm.vlm.network"
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


FLOATS = (np.random.default_rng(0).random((6, 32, 32, 3)) * 1.2).clip(0, 1)
CAST = FLOATS.astype(np.uint8)  # 0, and 1 where a float is 1, as some clients cast before they send
TOLD = "black pictures, no value above 1 (multiply floats in 0..1 by 255 before they become uint8)"


def test_floats_that_became_uint8_are_scored_with_a_warning_in_a_header_and_the_log(gateway: Gateway) -> None:
    assert set(np.unique(CAST)) == {0, 1}
    response = ask_json(gateway, [of_frames(CAST)])
    assert answered(response) == numbers(expected(gateway, [of_frames(CAST)]))
    warning = f"samples 0: {TOLD}: their scores mean nothing"
    assert response.headers["X-RFM-Warning"] == warning
    assert re.search(
        rf" WARNING .* request=\S+: {re.escape(warning)}", gateway.log
    )  # of this request or one just before


def test_frames_that_show_nothing_are_refused_where_the_gateway_is_told_so(changed: Gateway, ask: Ask) -> None:
    blank = filmed(1, 6) | {"frames": CAST}
    response = ask(changed, [progress(filmed(1, 6)), preference(filmed(2, 2), blank), progress(blank)])
    told = f"expected pictures that show something, got {TOLD}"
    paths = (["samples", 1, "rejected_trajectory", "frames"], ["samples", 2, "trajectory", "frames"])
    sent = as_parts if ask is ask_npy else list
    check_refused(response, *((sent(path), re.escape(told)) for path in paths))


def test_zeros_that_pad_a_clip_are_scored_with_a_warning_or_refused(gateway: Gateway, changed: Gateway) -> None:
    whole = filmed(1, 6)
    padded = whole | {"frames": np.concatenate([whole["frames"][:4], np.zeros_like(whole["frames"][:2])])}
    response = ask_json(gateway, [progress(whole), progress(padded), of_frames(CAST)])
    told = "frames of zeros at the end (send the real frames alone, without padding)"
    warning = f"samples 2: {TOLD}: their scores mean nothing; samples 1: {told}: they are scored as pictures"
    assert response.headers["X-RFM-Warning"] == warning
    refusal = re.escape(f"expected pictures that show something, got {told}")
    check_refused(ask_json(changed, [progress(padded)]), (["samples", 0, "trajectory", "frames"], refusal))


def test_the_guide_names_each_project_whose_requests_are_sent_and_the_longest_that_it_waits() -> None:
    guide = (ROOT / "docs" / "guides" / "robometer_clients.md").read_text()
    rows = {row.split(" | ")[0].removeprefix("| "): row for row in guide.splitlines() if row.startswith("| ")}
    for client in CLIENTS.values():
        if client["project"] != "unknown":
            assert f"{client['timeout_s']} s" in rows[client["project"]]
