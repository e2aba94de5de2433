# SPDX-License-Identifier: MIT
"""Robometer as LeRobot publishes it: scores of LeRobot's own code, and checkpoints that are refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from reward_models import BASE, ROOT, Reference, references
from rfm import published
from rfm.engine import Engine
from rfm_client import ProgressResult
from spoilt import Spoil, in_json, weights, with_sources

CASES = references("lerobot_robometer")
CHECKPOINT = ROOT / "lerobot_robometer" / "tok_disc10" / "checkpoint"
TOLERANCES = (1e-4, 2e-5)  # of logits and answers in float32; seen: 2e-6, 3e-7
ROUNDED = 0.05  # of answers in bfloat16
TOKENS = "model.lm_head.weight"


def check(results: list[Any], decoded: dict[str, Any], frames_per_value: int, tolerance: float) -> None:
    for result, progress, success in zip(results, decoded["progress_pred"], decoded["success_probs"], strict=True):
        assert isinstance(result, ProgressResult)
        np.testing.assert_allclose(result.progress[::frames_per_value], progress, rtol=0, atol=tolerance)
        np.testing.assert_allclose(result.success[::frames_per_value], success, rtol=0, atol=tolerance)


@pytest.mark.reference
@pytest.mark.parametrize("case", CASES, ids=str)
def test_scores_are_those_of_lerobot(case: Reference) -> None:
    content, frames_per_value = case.content, 1 if case.summary["use_multi_image"] else 2
    last, is_rounded = content.get("cropped_to_last"), case.summary["torch_dtype"] == "bfloat16"
    engine = Engine.of(published.load(str(case.config / "checkpoint"), base_model=str(BASE)))
    results = engine.evaluate(case.samples(last))
    if is_rounded:
        rounded = Engine.of(published.load(str(case.config / "checkpoint"), base_model=str(BASE)), dtype=torch.bfloat16)
        check(rounded.evaluate(case.samples(last)), content["decoded"], frames_per_value, ROUNDED)
        if "fp32_decoded" in content:
            check(results, content["fp32_decoded"], frames_per_value, TOLERANCES[1])
        return
    check(results, content["decoded"], frames_per_value, TOLERANCES[1])
    if "all_frames" in content:
        check(engine.evaluate(case.samples()), content["all_frames"]["decoded"], frames_per_value, TOLERANCES[1])
    if case.summary["progress_head_outputs"] > 1 and content["upstream_status"] == "ok":
        for result, expected in zip(results, case.arrays["progress.progress_logits_A"], strict=True):
            assert isinstance(result, ProgressResult)
            assert result.progress_logits is not None
            got = result.progress_logits[::frames_per_value]
            np.testing.assert_allclose(got, expected[: len(got)], rtol=0, atol=TOLERANCES[0])


def test_an_export_scores_the_same_and_its_assumptions_are_listed(tmp_path: Path) -> None:
    case = next(case for case in CASES if case.config == CHECKPOINT.parent)
    loaded = published.read(CHECKPOINT, base_model=str(BASE))
    loaded.checkpoint.save(tmp_path / "saved")
    saved = Engine.of(published.load(str(tmp_path / "saved"))).evaluate(case.samples())
    for result, expected in zip(saved, Engine.of(loaded.checkpoint).evaluate(case.samples()), strict=True):
        assert isinstance(result, ProgressResult)
        assert isinstance(expected, ProgressResult)
        np.testing.assert_array_equal(result.progress, expected.progress)
    assumed = [each.name for each in loaded.assumptions]
    # the tests' own processor, and a prompt about pairs, which LeRobot does not score
    assert assumed == ["base_model", "progress_in_preference"]


def of_vlm(change: Callable[[dict[str, Any]], object]) -> Spoil:
    return in_json("config.json", lambda config: change(config["vlm_config"]))


def test_the_theta_of_the_rotation_is_the_file_s(tmp_path: Path) -> None:
    folder, options = with_sources("robometer of LeRobot", tmp_path)
    of_vlm(lambda config: config["text_config"]["rope_parameters"].update(rope_theta=20_000.0))(folder)
    assert published.load(folder, **options).config.backbone["text_config"]["rope_theta"] == 20_000.0


def test_of_untied_weights_the_embedding_is_read(tmp_path: Path) -> None:
    name, folder = "model.model.language_model.embed_tokens.weight", with_sources("robometer of LeRobot", tmp_path)[0]
    weights(lambda w: w.update({name: w[TOKENS].clone(), TOKENS: torch.zeros_like(w[TOKENS])}))(folder)
    of_vlm(lambda config: config.update(tie_word_embeddings=False))(folder)
    case = next(case for case in CASES if case.config == CHECKPOINT.parent)
    engine = Engine.of(published.load(folder, base_model=str(BASE)))
    check(engine.evaluate(case.samples(case.content.get("cropped_to_last"))), case.content["decoded"], 1, TOLERANCES[1])


def test_a_head_of_one_output_is_that_of_a_distance_loss(tmp_path: Path) -> None:
    folder, options = with_sources("robometer of LeRobot", tmp_path)
    head = "progress_head.4."
    one = {f"{head}{name}": slice(1) for name in ("weight", "bias")}
    weights(lambda w: w.update({name: w[name][rows].clone() for name, rows in one.items()}))(folder)
    in_json("config.json", lambda config: config.update(progress_loss_type="l2"))(folder)
    assert published.load(folder, **options).config.progress_bins == 1
