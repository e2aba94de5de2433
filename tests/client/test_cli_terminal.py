# SPDX-License-Identifier: MIT
"""rfm-client on a terminal with 80 columns, synthetic samples, and how results become documents."""

from __future__ import annotations

import importlib.metadata
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import clip
from client_commands import MODEL, RFM_CLIENT, TASK, ask, assert_scores, invoke
from engine_server import EngineServer
from rfm_client import FrameScores, ProgressResult
from rfm_client.cli.documents import frame_document
from rfm_client.cli.options import SyntheticSamples
from rfm_client.cli.scoring import unique_stems
from rfm_client.cli.show import status_tables
from rfm_client.command_line import ExitCode, number
from rfm_client.contract.description import TOY
from rfm_client.serving import ServerStatus
from rfm_client.transport.status import ModelStatus
from servers import Endpoints

WIDTH = 80  # of a terminal
NAMES = ("episode_a.mp4", "episode_b.mp4")


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("a_folder_of_which_the_name_is_long") / "observation.images.front" / "chunk-000"
    folder.mkdir(parents=True)
    for name in NAMES:
        clip.write(folder / name)
    return [folder / name for name in NAMES]


def shown(url: str, *asked: object, code: ExitCode = ExitCode.OK) -> tuple[set[str], str]:
    """Run a command about the demo's checkpoint. Return words and lines, which fit the terminal."""
    path = f"{RFM_CLIENT.parent}:{os.environ['PATH']}"  # or commands would begin with the program's folder
    result = invoke(*asked, "--url", url, env={"COLUMNS": f"{WIDTH}", "PATH": path})
    assert result.exit_code == code, result.output
    lines = [line for line in result.stdout.splitlines() if line.strip() not in map(str, asked)]  # paths are never cut
    assert max(map(len, lines)) <= WIDTH
    return {*result.stdout.split()}, result.stdout


def test_status_fits_a_terminal(demo_server: Endpoints) -> None:
    url = demo_server.grpc_url
    words, _ = shown(url, "status", "--metrics-url", demo_server.metrics_url)
    heads = {"model", "v", "state", "requests", "failed", "refused", "pending", "batches", "samples", "queue", "ms"}
    assert heads | {"rfm", "rfm_encoder", "rfm_frames", "demo_checkpoint"} <= words


def test_scores_and_figures_of_the_toy_checkpoint_say_that_they_mean_nothing(
    demo_server: Endpoints, video: Path, tmp_path: Path
) -> None:
    words = ("--url", demo_server.grpc_url, "--task", TASK, "--plot", tmp_path / "plot.svg")
    result = invoke("score", video, *words)
    assert (result.exit_code, result.stderr.count(f"note: {TOY}")) == (0, 1)
    assert "demo_checkpoint scored these frames in one pass" in result.stdout
    drawn = (tmp_path / "plot.svg").read_text()
    assert all(f"<!-- {line} -->" in drawn for line in ("demo_checkpoint", TOY))
    result = invoke("compare", video, video, *words[:-2])
    assert (result.exit_code, result.stderr.count(f"note: {TOY}")) == (0, 1)
    assert "demo_checkpoint compared each video" in result.stdout
    result = invoke("score", video, *words, "--caption", "how it went")
    drawn = (tmp_path / "plot.svg").read_text()
    assert all(f"<!-- {line} -->" in drawn for line in ("how it went", TOY))


def test_scores_and_comparisons_fit_a_terminal_and_name_each_file(engines: EngineServer, videos: list[Path]) -> None:
    words, _ = shown(engines.url, "score", *videos, "missing.mp4", "--task", TASK, code=ExitCode.FAILED)
    assert {"video", "progress", "success", "frames", "version"} <= words
    assert {word for word in words if word.endswith(NAMES)} == set(map(str, videos))
    words, _ = shown(engines.url, "compare", *videos, "--task", TASK)
    assert {"#", "rank", "P(wins)", "progress", "success", "frames", "second", "mean", "orders"} <= words
    assert {word for word in words if word.endswith(".mp4")} == set(map(str, videos))


def test_the_reason_of_a_model_that_is_not_ready_has_a_line_of_its_own() -> None:
    model = ModelStatus("rfm_encoder", "1", "UNAVAILABLE", "a [reason]", 1, 2, None, 3, 4, 5.0, 6.0, samples_refused=7)
    status = ServerStatus("grpc://localhost:8001", "2.51.0", False, (model,), "", "no metrics", ())
    shown = status_tables(status)
    first, second = (line for line in shown.splitlines() if line.strip().startswith("rfm_encoder  1"))
    assert first.split() == ["rfm_encoder", "1", "UNAVAILABLE", "1", "2", "7", "-"]
    assert second.split() == ["rfm_encoder", "1", "4", "0.8", "1.50", "5.00", "load"]
    assert "rfm_encoder 1: a [reason]\n" in shown
    assert shown.rstrip().endswith("no metrics")


PROGRAMS: dict[str, list[object]] = {
    "rfm rfm-triton": [RFM_CLIENT.parent / "rfm"],
    "rfm-client rfm-client": [sys.executable, "-m", "rfm_client"],
}


@pytest.mark.parametrize(("names", "words"), PROGRAMS.items())
def test_each_command_prints_its_version(names: str, words: list[object]) -> None:
    program, distribution = names.split()
    done = subprocess.run([*map(str, words), "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"{program} {importlib.metadata.version(distribution)}\n"


SAMPLES = {"embeddings": ("progress", False), "pairs": ("similarity", False), "frames": ("preference", True)}


@pytest.mark.parametrize(("kind", "use_frames"), SAMPLES.values(), ids=SAMPLES)
def test_sample_scores_synthetic_samples(engines: EngineServer, kind: Any, use_frames: bool) -> None:
    words = ["--sample-type", kind, "--num-samples", 3, "--num-frames", 5]
    words += ["--use-frames"] if use_frames else []
    result = ask(engines, "sample", *words, "--json", "-")
    assert (result.exit_code, result.stderr) == (0, "")
    with engines.client(MODEL) as client:
        expected = client.evaluate(SyntheticSamples(kind, 3, 5, use_frames).samples(client))
    for answer, scores in zip(json.loads(result.stdout)["samples"], expected, strict=True):
        if isinstance(scores, ProgressResult):
            assert_scores(answer, scores)
        else:
            assert answer[kind] == pytest.approx(getattr(scores, kind), abs=1e-4)
            for name in ("first", "second") if kind == "preference" else ("reference", "other"):
                assert_scores(answer[name], getattr(scores, name))


def test_sample_shows_a_table_and_once_why_samples_failed(engines: EngineServer) -> None:
    result = ask(engines, "sample", "--sample-type", "preference", "--num-samples", 2, "--num-frames", 17)
    assert (result.exit_code, result.stdout) == (ExitCode.FAILED, "")
    (line,) = result.stderr.splitlines()
    assert line.startswith("rfm-client: samples[0] and 1 more: num_frames: expected at most 16")
    good = ask(engines, "sample", "--sample-type", "preference", "--num-samples", 1)
    with engines.client(MODEL) as client:
        (expected,) = client.evaluate(SyntheticSamples("preference", 1).samples(client))
    assert f"P(first) = {expected.preference:.4f}" in good.stdout  # type: ignore[union-attr]


def test_a_score_that_is_not_predicted_is_null_in_json_and_shown_as_a_dash() -> None:
    scores = FrameScores(progress=np.float32([0.25, 0.5]), success=np.full(2, np.nan, np.float32))
    document = frame_document(scores, None)
    assert (document["progress"], document["success"]) == ([0.25, 0.5], None)
    assert [number(value) for value in (None, float("nan"), 0.5)] == ["-", "-", "0.5000"]


def test_videos_of_one_name_are_told_apart() -> None:
    names = ["a/clip.mp4", "b/clip.mp4", "c/clip.mp4", "other.tar.mp4"]
    assert unique_stems(names) == ["1_clip", "2_clip", "3_clip", "4_other.tar"]
    assert unique_stems(names[1:2] + names[3:]) == ["clip", "other.tar"]
