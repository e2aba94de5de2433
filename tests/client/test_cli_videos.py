# SPDX-License-Identifier: MIT
"""rfm-client score and compare."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import clip
from client_commands import MODEL, TASK, WIDTHS, ask, assert_scores, columns, invoke, run
from engine_server import EngineServer
from rfm_client import (
    FrameScores,
    InferenceFailedError,
    PreferenceResult,
    ProgressResult,
    RewardClient,
    Trajectory,
    load_trajectory,
)
from rfm_client.cli.comparing import NO_VERDICT, Comparison, compare
from rfm_client.cli.options import VideoOptions
from rfm_client.cli.pictures import Panel, plot
from rfm_client.cli.scoring import Source
from rfm_client.command_line import ExitCode
from servers import Served, folder_server
from shelves import Shelf
from tolerances import TOLERANCE
from trajectories import random_trajectory

MAX_FRAMES = 16  # of that checkpoint
EVENLY = np.rint(np.linspace(0, clip.NUM_FRAMES - 1, MAX_FRAMES)).astype(int)


@pytest.mark.slow
def test_score_writes_the_client_s_scores_and_one_bad_video_does_not_stop_the_others(
    engines: EngineServer, video: Path, tmp_path: Path
) -> None:
    embeddings = tmp_path / "embeddings.npz"
    seen = random_trajectory(3, 5, *WIDTHS)
    np.savez(embeddings, video_embeddings=seen.video_embeddings, text_embedding=seen.text_embedding)
    missing = tmp_path / "missing.mp4"
    target = tmp_path / "scores.json"
    plotted = tmp_path / "plot.png"
    result = run(
        *("score", video, missing, embeddings, "--task", TASK, "--fps", 10, "--model", MODEL),
        *("--json", target, "--plot", plotted, "--strips", tmp_path / "strips.png"),
        RFM_URL=f"{engines.url} {engines.url}",
    )
    assert result.returncode == ExitCode.FAILED
    assert result.stderr.splitlines() == [
        f"rfm-client: note: {video}: 16 of 32 frames were scored, evenly spaced",
        f"rfm-client: {missing}: video: expected a video file, got no file of this name",
    ]
    with engines.client(MODEL) as client:
        filmed = client.progress(load_trajectory(video, task=TASK, fps=10), subsample=True)
        embedded = client.progress(seen)

    document = json.loads(target.read_text())
    assert document["servers"] == [engines.url] * 2
    assert (document["model"], document["task"], document["fps"]) == (MODEL, TASK, 10)
    first, failed, second = document["videos"]
    assert_scores(first, filmed)
    assert_scores(second, embedded)
    assert (first["source"], first["num_frames"], first["model_version"]) == (str(video), 32, "1")
    assert first["frame_indices"] == EVENLY.tolist()
    np.testing.assert_allclose(first["frame_times_s"], EVENLY / clip.FPS)
    assert second["frame_indices"] == list(range(5))
    assert second["frame_times_s"] is None
    assert failed["source"] == str(missing)
    assert failed["error_type"] == "InvalidSampleError"

    assert columns(result.stdout, str(video))[1:5] == [
        *(f"{first[name][-1]:.4f}" for name in ("progress", "success")),
        "16 of 32",
        "3.1",
    ]
    assert columns(result.stdout, str(embeddings))[3:5] == ["5", "-"]

    with Image.open(plotted) as curves, Image.open(tmp_path / "strips.png") as strips:
        assert (curves.width, strips.width) == (700, 1400)


OPTIONS: dict[str, tuple[list[object], dict[str, Any]]] = {
    "each prefix by a rule": (["--sampling", "linspace_trunc", "--frames", 4], {"frame_steps": 4}),
    "resized": (["--resize"], {"subsample": True, "resize": True}),
}


@pytest.mark.parametrize(("words", "options"), OPTIONS.values(), ids=OPTIONS)
def test_score_passes_its_options_on(
    engines: EngineServer, video: Path, words: list[object], options: dict[str, Any]
) -> None:
    result = ask(engines, "score", video, "--task", TASK, *words, "--json", "-")
    assert (result.exit_code, result.stderr) == (0, "")
    (scored,) = json.loads(result.stdout)["videos"]  # and nothing but JSON
    with engines.client(MODEL) as client:
        expected = client.progress(load_trajectory(video, task=TASK, fps=3.0), **options)
    assert_scores(scored, expected)
    np.testing.assert_allclose(scored["frame_times_s"], np.linspace(0, 31, 10).astype(int) / clip.FPS)


def test_score_and_compare_apply_the_options_orient_and_channels(
    engines: EngineServer, video: Path, tmp_path: Path
) -> None:
    upright, stored = load_trajectory(video, fps=3.0).positions, tmp_path / "stored.npy"
    np.save(stored, upright[:, ::-1, :, ::-1])
    asked = ("--task", TASK, "--orient", "flip-vertical", "--channels", "bgr", "--json", "-")
    told = json.loads(ask(engines, "score", stored, *asked).stdout)
    compared = json.loads(ask(engines, "compare", stored, video, *asked).stdout)
    for document in (told, compared):
        assert (document["orient"], document["channels"]) == ("flip-vertical", "bgr")
    first, second = (Trajectory(frames=frames, task=TASK) for frames in (upright, upright[:, ::-1, :, ::-1]))
    with engines.client(MODEL) as client:
        assert_scores(told["videos"][0], client.progress(first))
        preference = client.preference(first, second).preference
    assert compared["preference"] == pytest.approx(preference, abs=TOLERANCE)


def test_score_reads_videos_behind_urls(engines: EngineServer, video: Path) -> None:
    with folder_server(video.parent) as url:
        result = ask(engines, "score", f"{url}/clip.mp4", video, "--task", TASK, "--json", "-")
    remote, local = json.loads(result.stdout)["videos"]
    np.testing.assert_allclose(remote["progress"], local["progress"], rtol=0, atol=TOLERANCE)
    assert remote["frame_times_s"] is None


def test_compare_asks_in_both_orders_and_shows_the_scores_of_score(served: Served, video: Path, tmp_path: Path) -> None:
    small, target = tmp_path / "small.npy", tmp_path / "scores.json"
    np.save(small, np.random.default_rng(0).integers(0, 256, (20, 40, 30, 3), np.uint8))
    files = [video, small]
    asked_of = ("--task", TASK, "--url", served.url("grpc"), "--model", MODEL)
    result = invoke("compare", *files, *asked_of, "--json", target)
    told = f"rfm-client: note: {small}: 16 of 20 frames were scored, evenly spaced\n"
    assert (result.exit_code, result.stderr) == (0, told)
    first, second = load_trajectory(video, task=TASK, fps=3), load_trajectory(small, task=TASK)
    with served.client("grpc", MODEL) as client:
        asked = client.preference(first, second, subsample=True).preference
        swapped = 1 - client.preference(second, first, subsample=True).preference
    document = json.loads(target.read_text())
    np.testing.assert_allclose(document["both_orders"], [asked, swapped], rtol=0, atol=TOLERANCE)
    wins = (sum(document["both_orders"]) / 2, 1 - sum(document["both_orders"]) / 2)
    scored = json.loads(invoke("score", *files, *asked_of, "--json", "-").stdout)["videos"]
    for each, alone, file, share in zip((document["first"], document["second"]), scored, files, wins, strict=True):
        assert each["source"] == str(file)
        for name in ("progress", "success"):
            np.testing.assert_allclose(each[name], alone[name], rtol=0, atol=TOLERANCE)
        figures = [f"{figure:.4f}" for figure in (share, each["progress"][-1], each["success"][-1])]
        assert columns(result.stdout, str(file))[1:] == [*figures, str(len(each["progress"]))]
    assert document["second"]["frame_indices"] == np.rint(np.linspace(0, 19, 16)).astype(int).tolist()


def test_compare_of_two_videos_has_their_preference_and_verdict(engines: EngineServer, tmp_path: Path) -> None:
    files = [tmp_path / f"{name}.npz" for name in "ab"]
    first, second = (random_trajectory(seed, 3 + seed, *WIDTHS) for seed in range(2))
    for file, seen in zip(files, (first, second), strict=True):
        np.savez(file, video_embeddings=seen.video_embeddings, text_embedding=seen.text_embedding)
    result = ask(engines, "compare", *files, "--json", "-")
    document = json.loads(result.stdout)
    with engines.client(MODEL) as client:
        expected = client.preference(first, replace(second, text_embedding=None), both_orders=True)
        once = client.preference(first, second)
        alone = [client.progress(each) for each in (first, replace(second, text_embedding=first.text_embedding))]
    assert document["preference"] == pytest.approx(once.preference, abs=TOLERANCE)
    assert_scores(document["first"], alone[0])
    assert_scores(document["second"], alone[1])
    assert (document["verdict"], document["orders_agree"]) == (expected.verdict, expected.orders_agree)


def test_compare_refuses_the_answers_of_two_versions(tmp_path: Path, video: Path) -> None:
    np.save(tmp_path / "small.npy", np.zeros((2, 40, 30, 3), np.uint8))  # of another size: a separate request
    with (
        RewardClient("", transports=[Shelf(after=1)]) as client,
        pytest.raises(
            InferenceFailedError, match=r"^model_version: expected one for both orders, got 2, 1: ask again$"
        ),
    ):
        compare(client, [str(video), str(tmp_path / "small.npy")], VideoOptions(task=TASK))


def test_a_plot_has_a_strip_for_each_video_and_is_drawn_without_scores_too(tmp_path: Path) -> None:
    told = FrameScores(progress=np.linspace(0, 1, 12, dtype=np.float32), success=np.full(12, np.nan, np.float32))
    frames = np.random.default_rng(0).integers(0, 256, (12, 8, 8, 3), np.uint8)
    panels = [Panel.of("costs $5_$ 漢字", told, frames), Panel.of("[embeddings]", told)]
    plot(tmp_path / "plot.svg", panels, title="both")
    drawn = (tmp_path / "plot.svg").read_text()
    corners = re.findall(r'id="image[^>]* x="([\d.]+)" y="[^"]*" width="([\d.]+)"', drawn)
    middles = np.array([float(x) + float(width) / 2 for x, width in corners])
    frames_shown = (middles - middles[0]) / (middles[-1] - middles[0]) * 11
    np.testing.assert_allclose(frames_shown, [0, 2, 4, 7, 9, 11], atol=0.02)  # they stand at their times
    assert (np.diff(middles) >= float(corners[0][1])).all()


ORDERS = {
    "agree": (0.4, 0.9, "The second video does the task better."),
    "disagree by a hair": (0.5001, 0.5001, NO_VERDICT),
    "both are even": (0.5, 0.5, NO_VERDICT),
    "the first wins": (0.9, 0.2, "The first video does the task better."),
}


@pytest.mark.parametrize(("asked", "swapped", "verdict"), ORDERS.values(), ids=ORDERS)
def test_a_comparison_names_no_winner_where_the_orders_disagree(asked: float, swapped: float, verdict: str) -> None:
    scores = ProgressResult(progress=np.zeros(2, np.float32), success=np.zeros(2, np.float32))
    sources = [Source(f"{index}.npz", random_trajectory(0, 2, *WIDTHS), None) for index in range(2)]
    orders = [PreferenceResult(preference=each, first=scores, second=scores) for each in (asked, swapped)]
    shown = Comparison(sources, [scores] * 2, PreferenceResult.of_both_orders(*orders)).shown()
    told = f"P(first wins) = {asked:.4f}, with the order swapped {1 - swapped:.4f}."
    assert shown.splitlines()[-2:] == [told, verdict]
    assert [columns(shown, f"{index}.npz")[1] for index in range(2)] == [
        f"{share:.4f}" for share in ((asked + 1 - swapped) / 2, (1 - asked + swapped) / 2)
    ]
