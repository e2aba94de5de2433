# SPDX-License-Identifier: MIT
"""Checkpoints without some heads, such as the first ReWiND code's with progress alone, serve the others."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from google.protobuf import text_format
from safetensors.torch import save_file
from torch import Tensor, nn
from tritonclient.grpc import model_config_pb2 as pb

import goldens
import rfm_export
from engines import serve_config
from repositories import description_of
from rfm import published
from rfm.engine import Engine
from rfm.engine.family import Checkpoint
from rfm.files import CheckpointError
from rfm_client import (
    InvalidSampleError,
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Trajectory,
)
from rfm_client import SimilaritySample as Similarity
from rfm_client.contract.samples import blank_trajectory, random_trajectory
from rfm_commands.engine_scorer import EngineScorer
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


class FirstCode(nn.Module):
    """A narrow network of the first ReWiND code, as the repository describes it."""

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


@pytest.fixture(scope="module")
def first_code(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FirstCode]:
    """The weights that the first training script saves, in safetensors."""
    torch.manual_seed(0)
    network = FirstCode(max_length=16)
    for parameter in network.parameters():
        nn.init.normal_(parameter, std=0.3)
    folder = tmp_path_factory.mktemp("run")
    save_file(network.state_dict(), folder / "model.safetensors")
    return folder, network.eval()


@pytest.fixture
def run(first_code: tuple[Path, FirstCode], tmp_path: Path) -> Path:
    """A copy of the folder, which a test may change."""
    return shutil.copytree(first_code[0], tmp_path / "run")


def test_a_checkpoint_of_the_first_rewind_code_has_its_scores(first_code: tuple[Path, FirstCode]) -> None:
    folder, network = first_code
    loaded = published.read(folder)
    checkpoint = loaded.checkpoint
    assert (checkpoint.description.trained_frames, checkpoint.description.network_frames) == (16, None)
    assert checkpoint.description.lacks == ("preference", "similarity", "success")
    lacking, line = published.notes(folder, loaded)
    assert lacking == "model.safetensors: there is no head of preference and success: served without"
    source = "(default of the first ReWiND code)"
    assert line.startswith(
        "not shown by the checkpoint: "
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
    for option in ("image_encoder", "text_encoder"):
        with pytest.raises(CheckpointError, match=r": encoders: expected none for a checkpoint of the first ReWiND"):
            published.load(folder, **{option: "some/other"})


def test_a_checkpoint_of_the_first_rewind_code_is_exported_and_cannot_label(run: Path, tmp_path: Path) -> None:
    (run / "config.json").write_text('{"max_len": 32}')
    rfm_export.export(run, tmp_path / "repository", serve_config(goldens.config(REWIND)))
    loaded = published.read(run)
    exported = published.load(tmp_path / "repository" / "rfm" / "1" / "checkpoint")
    assert exported.config == loaded.checkpoint.config
    assert exported.config.trained_frames == 32
    _, assumed = published.notes(run, loaded)
    assert "causal_mask" in assumed
    assert "max_len" not in assumed
    assert [each.name for each in loaded.assumptions] == ["num_attention_heads", "causal_mask"]
    with pytest.raises(CheckpointError, match="expected encoders, since it scores embeddings, got none"):
        EngineScorer(str(run))


def test_a_checkpoint_of_the_first_rewind_code_is_causal_whatever_upstream_s_older_files_mean(run: Path) -> None:
    """Upstream's configurations from before causal_mask state all of these."""
    fields = ("video_feature_dim", "text_feature_dim", "hidden_dim", "num_layers", "num_attention_heads", "max_len")
    config = published.load(run).config
    (run / "config.json").write_text(json.dumps({name: getattr(config, name) for name in fields}))
    assert published.load(run).config == config
    assert config.causal_mask
