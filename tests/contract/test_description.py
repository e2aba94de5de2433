# SPDX-License-Identifier: MIT
"""The description of a checkpoint as JSON, and what clients read of it."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import pytest

from rfm_client import FrameSize, InferenceFailedError, ModelInfo
from rfm_client.contract.description import DESCRIPTION_PARAMETER, Description

# A value of each field, none of them its default.
FULL = Description(
    source="org/name", revision="0123abcd", license="mit", run_config={"data": {"max_frames": 8}},
    computation="float32, torch 2", weights_difference=0.012, kind="ReWiND", network={"class": "Rewind", "config": {}},
    video_dim=4, text_dim=2, progress_bins=10, trained_frames=16, trained_padding=False, network_frames=32,
    frame_size=FrameSize("exact", (224, 320)), frames_per_value=2, has_progress=False, has_preference=True, has_success=True,
    has_similarity=True, more_scores=("log_prob", "unclear"), scores_whole_prefixes=True, may_not_answer=True, needs_whole_episode=True,
    asks_in_words=True, reads_views=True, keeps_features=True, uses_graphs=True, is_large=True,
    weights_digest="12ab", settings_digest="34cd",
)  # fmt: skip
CONFIG: dict[str, Any] = {"name": "rfm", "max_batch_size": 64, "input": [], "output": []}


def test_a_description_survives_as_json() -> None:
    assert {
        each.name for each in fields(Description) if getattr(FULL, each.name) == getattr(Description(), each.name)
    } == set()
    assert Description.parse(FULL.to_json()) == FULL
    assert Description.parse(Description().to_json()) == Description()


def test_descriptions_of_older_and_newer_exports_are_read() -> None:
    assert Description.parse('{"kind": "ReWiND", "a_newer_fact": [1]}') == Description(kind="ReWiND")


def test_limits_of_training_and_network_make_one() -> None:
    assert [replace(FULL, trained_frames=n).max_frames for n in (16, 64, None)] == [16, 32, 32]
    assert Description().max_frames is None


WRONG = {
    "missing": ("", r"expected the JSON object of an export, got none"),
    "not JSON": ("{", r"expected the JSON object of an export, got '\{': Expecting property name"),
    "no object": ("[1]", r"expected the JSON object of an export, got '\[1\]'"),
    "a text for a number": ('{"text_dim": "32"}', r"text_dim: expected int or null, got '32'"),
    "null for a number": ('{"frames_per_value": null}', r"frames_per_value: expected int, got None"),
    "a list for an object": ('{"network": []}', r"network: expected Mapping, got \[\]"),
    "an unknown size": ('{"frame_size": "any"}', r"frame_size: expected 'shortest PX' or .*, got 'any'"),
}


@pytest.mark.parametrize(("text", "expected"), WRONG.values(), ids=WRONG)
def test_a_client_names_the_fault_of_a_description_and_its_remedy(text: str, expected: str) -> None:
    config = CONFIG | {"parameters": {DESCRIPTION_PARAMETER: {"string_value": text}}}
    with pytest.raises(
        InferenceFailedError,
        match=rf"^model rfm: config\.pbtxt: parameter description: {expected}.*; export the checkpoint again",
    ):
        ModelInfo.from_config(config)


def test_a_model_of_another_program_has_no_description() -> None:
    with pytest.raises(InferenceFailedError, match=r"^model rfm: .* got none; export the checkpoint again"):
        ModelInfo.from_config(CONFIG)
