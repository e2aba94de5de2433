# SPDX-License-Identifier: MIT
"""--resize: with a server and without one, frames become as small as what reads them first."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet
from typer.testing import CliRunner

from client_commands import invoke
from labelling import LEROBOT
from paths import ROOT
from rfm.launch.process import Endpoints
from rfm_client import RewardClient
from rfm_client.labelling import ClientScorer
from rfm_commands.cli import app
from rfm_commands.engine_scorer import EngineScorer

DATASET = LEROBOT / "toy_v30_many"
MODELS = ROOT / "model_repository"
CHECKPOINT = MODELS / "rfm" / "1" / "checkpoint"
ENCODERS = {name: str(MODELS / "rfm_encoder" / "1" / name) for name in ("image_encoder", "text_encoder")}
LABELS = "rfm_progress.parquet"


@pytest.mark.triton
def test_both_commands_resize_alike(demo_server: Endpoints, output: Path) -> None:
    with RewardClient(demo_server.grpc_url) as client:
        served = ClientScorer(client).checkpoint().frame_size
    told = json.loads((Path(ENCODERS["image_encoder"]) / "preprocessor_config.json").read_text())
    assert str(served) == f"shortest {told['size']['shortest_edge']}"
    assert EngineScorer(str(CHECKPOINT)).checkpoint().frame_size is None  # it reads no frames
    assert EngineScorer(str(CHECKPOINT), **ENCODERS).checkpoint().frame_size == served
    words = ["label", DATASET, "--episodes", "2", "--frames", 4, "--cameras", "front", "--no-picture"]
    folders = {name: output / name for name in ("served", "own", "whole")}
    for folder in folders.values():
        folder.mkdir()
    result = invoke(*words, "--resize", "--output", folders["served"], "--url", demo_server.grpc_url)
    assert result.exit_code == 0, result.stderr
    encoders = [f"--{name.replace('_', '-')}={folder}" for name, folder in ENCODERS.items()]
    for name, more in (("own", ["--resize"]), ("whole", [])):
        own = [*words, "--checkpoint", CHECKPOINT, *encoders, *more, "--output", folders[name]]
        result = CliRunner().invoke(app, list(map(str, own)))
        assert result.exit_code == 0, result.stderr
    scores = {name: parquet.read_table(folder / LABELS)["progress_sparse"] for name, folder in folders.items()}
    np.testing.assert_allclose(scores["own"], scores["served"], rtol=0, atol=1e-5)
    metadata = parquet.read_schema(folders["own"] / LABELS).metadata
    assert json.loads(metadata[b"rfm.provenance"])["resize"] == str(served)
    assert not np.array_equal(scores["own"], scores["whole"])  # or this test would see nothing
