# SPDX-License-Identifier: MIT
"""Checkpoints without heads, down to the first ReWiND code's, which predicts progress alone: what is there is served."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch
from google.protobuf import text_format
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from tritonclient.grpc import model_config_pb2 as pb

import goldens
import rfm_export
from engines import serve_config
from rfm import families
from rfm.checkpoint.content import CheckpointError
from rfm.checkpoint.provenance import Decision
from rfm.engine import Engine
from rfm.family import Checkpoint, Options
from rfm_client import (
    InvalidSampleError,
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Trajectory,
)
from rfm_client import SimilaritySample as Similarity
from rfm_client.contract.made_up import blank_trajectory, random_trajectory
from rfm_commands.engine_scorer import EngineScorer
from spoilt import run_the_command, without

REWIND, VLM = "c1_t1_disc10", "q3_tok_disc10"
LACKS = [("preference",), ("success",), ("preference", "success")]


def load(name: str, folder: Path) -> Checkpoint:
    return families.load(folder, base_model=str(goldens.config(name).base_model) if name == VLM else None)


def pair(name: str) -> tuple[Trajectory, Trajectory]:
    random, widths = np.random.default_rng(0), None if name == VLM else (768, 384)
    return tuple(random_trajectory(random, n, widths, task="lift", size_px=(56, 56)) for n in (3, 2))  # type: ignore[return-value]


def assert_close(got: npt.ArrayLike, expected: npt.ArrayLike) -> None:
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-5)  # seen: 2.2e-6


@pytest.mark.parametrize("heads", LACKS, ids="-".join)
@pytest.mark.parametrize("name", [REWIND, VLM])
def test_what_is_there_is_scored_as_with_all_heads_and_the_rest_refused_alone(
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
        assert type(outcome) is type(expected)
        for got, of_whole in zip(goldens.frame_scores(outcome), goldens.frame_scores(expected), strict=True):  # type: ignore[arg-type]
            assert_close(got.progress, of_whole.progress)
            if "success" in heads:
                assert np.isnan(got.success).all()
            else:
                assert_close(got.success, of_whole.success)
        for query in ("preference", "similarity"):
            assert_close(*(getattr(each, query, np.nan) for each in (outcome, expected)))


@pytest.mark.parametrize("name", [REWIND, VLM])
def test_a_score_that_is_not_finite_is_still_an_error(tmp_path: Path, name: str) -> None:
    """The value that stands for a missing head hides no fault of one that is there."""
    for heads, spoilt in (((), "success_head"), (("success",), "progress_head")):
        folder = without(name, heads, tmp_path / spoilt)
        weights = load_file(folder / "model.safetensors")
        weights[f"{spoilt}.4.bias"].fill_(torch.nan)
        save_file(weights, folder / "model.safetensors")
        family = families.choose(folder)
        base = str(goldens.config(name).base_model) if name == VLM else None
        (outcome,) = Engine.of(family.load(folder, Options(base_model=base))).evaluate([ProgressSample(pair(name)[0])])
        assert str(outcome) == "the network gave a score that is not finite"


@pytest.mark.parametrize("name", [REWIND, VLM])
def test_what_is_exported_has_the_same_heads(tmp_path: Path, name: str) -> None:
    folder = without(name, ["preference", "success"], tmp_path / "checkpoint")
    settings = replace(serve_config(goldens.config(name)), token_budget=4096)
    number = rfm_export.export(folder, tmp_path / "repository", settings)
    model = tmp_path / "repository" / ("rfm_frames" if name == VLM else "rfm")
    config = text_format.Parse((model / "config.pbtxt").read_text(), pb.ModelConfig())
    assert [warmup.name for warmup in config.model_warmup] == ["progress", *(["similarity"] if name == REWIND else [])]
    told = json.loads(config.parameters["network"].string_value)["config"]
    assert (told["has_preference"], told["has_success"]) == (False, False)
    exported = load(name, model / str(number) / "checkpoint")
    assert exported.config == load(name, folder).config
    assert rfm_export.check(tmp_path / "repository", settings) == []


def test_a_head_that_is_missing_is_not_said_to_be_untrained(tmp_path: Path) -> None:
    folder = without(REWIND, ["success"], tmp_path / "checkpoint")
    (folder / "config.yaml").write_text("model: {train_success_head: false, train_preference_head: false}\n")
    lacking, untrained = families.notes(folder, load(REWIND, folder))
    assert lacking == "model.safetensors: there is no head of success: served without"
    assert untrained.startswith("config.yaml: model.train_preference_head is false")


class FirstCode(nn.Module):
    """The network of the first ReWiND code, as its repository describes it, of a small width."""

    def __init__(self, max_length: int) -> None:
        super().__init__()
        self.video_proj, self.text_proj = nn.Linear(12, 32), nn.Linear(6, 32)
        self.first_pos_embed = nn.Parameter(torch.randn(1, 32))
        self.class_token = nn.Parameter(torch.randn(1, 1, 32))
        layer = nn.TransformerEncoderLayer(32, 8, 128, dropout=0.1, batch_first=True)
        self.transformer = nn.TransformerEncoder(layer, 4)
        head = (nn.Linear(32, 16), nn.LayerNorm(16), nn.GELU(), nn.Dropout(0.1), nn.Linear(16, 1), nn.Sigmoid())
        self.progress_head = nn.Sequential(*head)
        self.mask = nn.Transformer.generate_square_subsequent_mask(max_length + 1)

    def forward(self, video: Tensor, text: Tensor) -> Tensor:
        """float32 [B, T] of [B, T, 12] and [B, 6]."""
        frames = self.video_proj(video)
        first = frames[:, :1] + self.first_pos_embed
        tokens = torch.cat([self.text_proj(text)[:, None], first, frames[:, 1:]], dim=1)
        length = tokens.shape[1]
        hidden = self.transformer(tokens, mask=self.mask[:length, :length], is_causal=True)
        return self.progress_head(hidden[:, 1:]).squeeze(-1)


def first_code(folder: Path, max_length: int = 16) -> FirstCode:
    """A network of it, saved as its training script does."""
    torch.manual_seed(0)
    network = FirstCode(max_length)
    for parameter in network.parameters():
        nn.init.normal_(parameter, std=0.3)
    optimizer = torch.optim.Adam(network.parameters())
    run = {"epoch": 19, "optimizer_state_dict": optimizer.state_dict()}
    args = argparse.Namespace(max_length=max_length, subsample_video=True, lr=1e-4)
    folder.mkdir()
    torch.save({"args": args, "model_state_dict": network.state_dict(), **run}, folder / "rewind_epoch_19.pth")
    return network.eval()


def test_a_checkpoint_of_the_first_rewind_code_has_its_scores(tmp_path: Path) -> None:
    network = first_code(tmp_path / "run")
    run_the_command(families.load, tmp_path / "run")
    checkpoint = families.load(tmp_path / "run")
    assert (checkpoint.description.trained_frames, checkpoint.description.max_frames) == (16, None)
    assert checkpoint.description.lacks == {"preference", "success", "similarity"}
    lacking, line = families.notes(tmp_path / "run", checkpoint)
    assert lacking == "model.safetensors: there is no head of preference and success: served without"
    source = "(default of the first ReWiND code)"
    assert line.startswith(
        "assumed, and not shown by the checkpoint: "
        f"num_attention_heads 8 {source}; causal_mask true {source}; max_len 16 {source}; scores differ"
    )
    random = np.random.default_rng(0)
    trajectories = [random_trajectory(random, length, (12, 6), task="") for length in (1, 2, 9, 16)]
    outcomes = Engine.of(checkpoint).evaluate([ProgressSample(each) for each in trajectories])
    for trajectory, outcome in zip(trajectories, outcomes, strict=True):
        assert isinstance(outcome, ProgressResult)
        video, text = (torch.as_tensor(each)[None] for each in (trajectory.positions, trajectory.text_embedding))
        with torch.inference_mode():
            expected = network(video, text)[0].numpy()
        np.testing.assert_allclose(outcome.progress, expected, rtol=0, atol=1e-6)  # seen: 6.0e-8
        assert np.isnan(outcome.success).all()
    blank = blank_trajectory((12, 6))
    for sample in (PreferenceSample(blank, blank), Similarity(blank, blank)):
        (refused,) = Engine.of(checkpoint).evaluate([sample])
        assert str(refused).startswith("sample_type: expected progress (this checkpoint has no ")


def test_a_checkpoint_of_the_first_rewind_code_is_exported_and_labels(tmp_path: Path) -> None:
    first_code(tmp_path / "run", max_length=32)
    run_the_command(families.load, tmp_path / "run")
    (tmp_path / "run" / "config.json").write_text('{"max_len": 32}')
    rfm_export.export(tmp_path / "run", tmp_path / "repository", replace(serve_config(goldens.config(REWIND))))
    exported = families.load(tmp_path / "repository" / "rfm" / "1" / "checkpoint")
    assert exported.config == families.load(tmp_path / "run").config
    assert exported.config.trained_frames == 32
    scorer = EngineScorer(str(tmp_path / "run"))
    assert scorer.checkpoint().max_frames == 32
    assert "causal_mask" in scorer.notes[1]
    assert "max_len" not in scorer.notes[1]
    decisions = {each.name: each for each in families.load(tmp_path / "run").decisions()}
    assert decisions["max_len"] == Decision("max_len", 32, "config.json")
    assert decisions["trained_frames"] == Decision("trained_frames", 32, "max_len")
    assert decisions["has_success"] == Decision("has_success", False, "weights")


def test_a_checkpoint_of_the_first_rewind_code_is_causal_whatever_upstream_s_older_files_mean(tmp_path: Path) -> None:
    """Upstream's configurations of before causal_mask, when no network of theirs had one, state all of these."""
    first_code(tmp_path / "run")
    run_the_command(families.load, tmp_path / "run")
    fields = ("video_feature_dim", "text_feature_dim", "hidden_dim", "num_layers", "num_attention_heads", "max_len")
    config = families.load(tmp_path / "run").config
    (tmp_path / "run" / "config.json").write_text(json.dumps({name: getattr(config, name) for name in fields}))
    assert families.load(tmp_path / "run").config == config
    assert config.causal_mask


def test_a_checkpoint_of_the_first_rewind_code_takes_no_encoders(tmp_path: Path) -> None:
    first_code(tmp_path / "run")
    run_the_command(families.load, tmp_path / "run")
    for options in ({"image_encoder": "facebook/dinov2-base"}, {"text_encoder": "some/other"}):
        refused = partial(families.load, tmp_path / "run", **options)
        with pytest.raises(CheckpointError, match=r"run: encoders: expected none for a checkpoint of the first ReWiND"):
            refused()
