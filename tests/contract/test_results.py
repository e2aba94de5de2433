# SPDX-License-Identifier: MIT
"""Results: votes over success, rewards, verdicts; and the description of a checkpoint as JSON."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from every_score import assert_same_scores, every_score
from rfm_client import (
    FRAME_SCORES,
    FrameScores,
    FrameSize,
    InferenceFailedError,
    ModelInfo,
    PreferenceResult,
    ProgressResult,
)
from rfm_client.contract.description import DESCRIPTION_PARAMETER, Description

VOTES: dict[str, tuple[list[float], int, float, bool]] = {
    "the last frame": ([0.1, 0.9], 1, 0.5, True),
    "reaching is enough": ([0.5], 1, 0.5, True),
    "two of three": ([0.9, 0.2, 0.9], 3, 0.5, True),
    "half is no majority": ([0.9, 0.2], 2, 0.5, False),
    "fewer frames than asked": ([0.9], 5, 0.5, True),
    "a higher threshold": ([0.9], 1, 0.95, False),
    "only the last count": ([0.9, 0.9, 0.1], 1, 0.5, False),
}


@pytest.mark.parametrize(("success", "last", "threshold", "expected"), VOTES.values(), ids=VOTES)
def test_success_is_voted_over_the_last_frames(
    success: list[float], last: int, threshold: float, expected: bool
) -> None:
    scores = FrameScores(progress=np.zeros(1, np.float32), success=np.array(success, np.float32))
    assert scores.succeeded(last=last, threshold=threshold) is expected


def test_progress_becomes_a_reward() -> None:
    progress = np.array([0.25, 0.5, 0.375], np.float32)
    scores = FrameScores(progress=progress, success=progress)
    assert scores.last_progress == 0.375
    np.testing.assert_array_equal(scores.progress_deltas, np.array([0, 0.25, -0.125], np.float32))


def test_frames_can_be_taken_and_joined_without_loss_of_a_score() -> None:
    scores = every_score(0, 5)
    assert scores.arrays.keys() == FRAME_SCORES.keys()
    parts = [scores.at(slice(0, 2)), scores.at(slice(2, 3)), scores.at(np.array([3, 4]))]
    assert_same_scores(FrameScores.joined(parts), scores)
    assert_same_scores(scores.at(np.array([1, 1])), FrameScores.joined([parts[0].at(slice(1, None))] * 2))


def test_frames_that_are_taken_keep_their_indices() -> None:
    scores = replace(every_score(0, 3), frame_indices=np.array([0, 5, 9]))
    assert scores.at(slice(1, None)).scored_frames.tolist() == [5, 9]
    assert every_score(0, 3).scored_frames.tolist() == [0, 1, 2]


@pytest.mark.parametrize("name", [name for name, score in FRAME_SCORES.items() if not score.is_always_asked])
def test_parts_of_which_some_lack_a_score_are_not_joined(name: str) -> None:
    parts = [every_score(seed, 2) for seed in range(3)]
    parts[1] = replace(parts[1], **{name: None})  # type: ignore[arg-type]
    with pytest.raises(InferenceFailedError, match=f"^{name}: expected it for all 3 parts .* got it for 2"):
        FrameScores.joined(parts)


def test_parts_of_an_answer_are_of_one_version() -> None:
    parts = [ProgressResult(**vars(every_score(seed, 1)), model_version="3") for seed in range(2)]
    whole = ProgressResult.of_parts(parts)
    assert whole.model_version == "3"
    assert_same_scores(whole, FrameScores.joined(parts))
    with pytest.raises(InferenceFailedError, match="model_version: expected one for all frames, got 2, 3: ask again"):
        ProgressResult.of_parts([*parts, replace(parts[0], model_version="2")])


@pytest.mark.parametrize("name", ["last_progress", "progress_deltas", "succeeded"])
def test_a_score_that_a_checkpoint_does_not_predict_raises_an_error(name: str) -> None:
    nothing = np.full(2, np.nan, np.float32)
    scores = FrameScores(progress=nothing, success=nothing)
    with pytest.raises(ValueError, match="got NaN: this checkpoint does not predict it"):
        getattr(scores, name)() if name == "succeeded" else getattr(scores, name)


def test_the_leading_score_is_progress_or_the_score_predicted_in_its_place() -> None:
    assert seconds(3, 1).leading == "remaining_s"
    nothing = np.full(2, np.nan, np.float32)
    assert FrameScores(progress=nothing, success=nothing).leading == "progress"
    both = FrameScores(progress=np.ones(2, np.float32), success=nothing, remaining_s=np.ones(2, np.float32))
    assert both.leading == "progress"
    assert {name: score.title(name) for name, score in FRAME_SCORES.items() if score.unit} == {
        "remaining_s": "remaining (s)", "relative_s": "relative (s)", "entropy": "entropy (nats)",
    }  # fmt: skip


def seconds(*remaining_s: float) -> FrameScores:
    nothing = np.full(len(remaining_s), np.nan, np.float32)
    return FrameScores(progress=nothing, success=nothing, remaining_s=np.array(remaining_s, np.float32))


def test_a_named_rule_makes_progress_of_seconds() -> None:
    scores = seconds(8, 6, 10, 0, -1)
    np.testing.assert_array_equal(scores.progress_by("remaining_over_first"), np.array([0, 0.25, 0, 1, 1], np.float32))
    assert np.isnan(scores.progress).all()


def test_without_seconds_no_rule_makes_progress() -> None:
    with pytest.raises(ValueError, match="remaining_s: expected seconds, got none"):
        replace(every_score(0, 2), remaining_s=None).progress_by("remaining_over_first")
    with pytest.raises(ValueError, match="remaining_s: expected more than 0 at the first frame, got 0"):
        seconds(0, 1).progress_by("remaining_over_first")
    with pytest.raises(ValueError, match="rule: expected one of remaining_over_first, got 'best'"):
        seconds(1).progress_by("best")  # type: ignore[arg-type]


VERDICTS: dict[str, tuple[float, float | None, float, bool | None, str | None]] = {
    "second, asked once": (0.1, None, 0.1, None, "second"),
    "even, asked once": (0.5, None, 0.5, None, None),
    "first": (0.75, 0.25, 0.75, True, "first"),
    "disagree": (0.75, 0.75, 0.5, False, None),
    "one is even": (0.75, 0.5, 0.625, False, None),
    "both are even": (0.5, 0.5, 0.5, True, None),
}


def preferred(preference: float, version: str = "1") -> PreferenceResult:
    scores = FrameScores(progress=np.zeros(2, np.float32), success=np.zeros(2, np.float32))
    return PreferenceResult(preference=preference, first=scores, second=scores, model_version=version)


@pytest.mark.parametrize(("asked", "swapped", "mean", "agree", "verdict"), VERDICTS.values(), ids=VERDICTS)
def test_there_is_a_verdict_where_the_orders_agree(
    asked: float, swapped: float | None, mean: float, agree: bool | None, verdict: str | None
) -> None:
    result = preferred(asked)
    if swapped is not None:
        result = PreferenceResult.of_both_orders(result, preferred(swapped))
        assert result.both_orders == (asked, 1 - swapped)
    assert (result.preference, result.orders_agree, result.verdict) == (mean, agree, verdict)


def test_orders_that_two_versions_answered_are_an_error() -> None:
    with pytest.raises(InferenceFailedError, match=r"^model_version: expected one for both orders, got 1, 2: ask"):
        PreferenceResult.of_both_orders(preferred(0.5), preferred(0.5, "2"))


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
    "a list for an object": ('{"network": []}', r"network: expected Mapping, got \[\]"),
    "an unknown size": ('{"frame_size": "any"}', r"frame_size: expected 'shortest PX' or .*, got 'any'"),
}


@pytest.mark.parametrize(("text", "expected"), WRONG.values(), ids=WRONG)
def test_a_client_names_the_fault_of_a_description_and_its_remedy(text: str, expected: str) -> None:
    config = CONFIG | ({"parameters": {DESCRIPTION_PARAMETER: {"string_value": text}}} if text else {})
    with pytest.raises(
        InferenceFailedError,
        match=rf"^model rfm: config\.pbtxt: parameter description: {expected}.*; export the checkpoint again",
    ):
        ModelInfo.from_config(config, ["1"])
