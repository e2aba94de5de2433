# SPDX-License-Identifier: MIT
"""Checkpoints without some heads serve the others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from google.protobuf import text_format
from tritonclient.grpc import model_config_pb2 as pb

import goldens
import rfm_export
from engines import serve_config
from repositories import description_of
from rfm import published
from rfm.engine import Engine
from rfm.engine.family import Checkpoint
from rfm_client import (
    InvalidSampleError,
    PreferenceResult,
    PreferenceSample,
    ProgressSample,
    Trajectory,
)
from rfm_client import SimilaritySample as Similarity
from rfm_client.contract.samples import random_trajectory
from spoilt import without
from vlm import assert_close

REWIND, VLM = "c1_t1_disc10", "q3_tok_disc10"
LACKS = [("preference",), ("success",), ("preference", "success")]


def load(name: str, folder: Path) -> Checkpoint:
    return published.load(folder, **goldens.config(name).sources)


def pair(name: str) -> tuple[Trajectory, Trajectory]:
    random, widths = np.random.default_rng(0), None if name == VLM else (768, 384)
    return tuple(random_trajectory(random, n, widths, task="lift", size_px=(56, 56)) for n in (3, 2))  # type: ignore[return-value]


@pytest.mark.parametrize("heads", LACKS, ids="-".join)
@pytest.mark.parametrize("name", [REWIND, VLM])
def test_present_heads_score_as_with_all_heads_and_samples_of_missing_ones_are_refused(
    tmp_path: Path, name: str, heads: tuple[str, ...]
) -> None:
    folder = without(name, heads, tmp_path / "checkpoint")
    first, second = pair(name)
    samples = [ProgressSample(first), PreferenceSample(first, second), ProgressSample(first, frame_steps=2)]
    if name == REWIND:
        samples.append(Similarity(first, second))  # type: ignore[arg-type]
    whole = Engine.of(load(name, goldens.config(name).checkpoint)).evaluate(samples)
    for outcome, expected in zip(Engine.of(load(name, folder)).evaluate(samples), whole, strict=True):
        if isinstance(expected, PreferenceResult) and "preference" in heads:
            assert isinstance(outcome, InvalidSampleError)
            supported = "progress or similarity" if name == REWIND else "progress"
            told = f"sample_type: expected {supported} (this checkpoint has no preference head), got preference"
            assert str(outcome) == told
            continue
        if "success" in heads:
            for scores in goldens.frame_scores(expected):  # type: ignore[arg-type]
                scores.success[:] = np.nan
        assert type(outcome) is type(expected)
        assert_close(outcome, expected, 1e-5)  # seen: 2.2e-6


@pytest.mark.parametrize("name", [REWIND, VLM])
def test_an_exported_checkpoint_has_the_same_heads(tmp_path: Path, name: str) -> None:
    folder = without(name, ["preference", "success"], tmp_path / "checkpoint")
    settings = replace(serve_config(goldens.config(name)), token_budget=4096)
    number = rfm_export.export(folder, tmp_path / "repository", settings)
    model = tmp_path / "repository" / ("rfm_frames" if name == VLM else "rfm")
    config = text_format.Parse((model / "config.pbtxt").read_text(), pb.ModelConfig())
    assert [warmup.name for warmup in config.model_warmup] == ["progress", *(["similarity"] if name == REWIND else [])]
    told = description_of(model).network["config"]
    assert (told["has_preference"], told["has_success"]) == (False, False)
    exported = load(name, model / str(number) / "checkpoint")
    assert exported.config == load(name, folder).config
    assert rfm_export.check(tmp_path / "repository", settings) == []


def test_a_head_that_is_missing_is_not_said_to_be_untrained(tmp_path: Path) -> None:
    folder = without(REWIND, ["success"], tmp_path / "checkpoint")
    (folder / "config.yaml").write_text("model: {train_success_head: false, train_preference_head: false}\n")
    lacking, untrained = published.notes(folder, published.read(folder))
    assert lacking == "model.safetensors: there is no head of success: served without"
    assert untrained.startswith("config.yaml: model.train_preference_head is false")
