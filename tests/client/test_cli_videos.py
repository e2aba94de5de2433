# SPDX-License-Identifier: MIT
"""rfm-client score and compare."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import clip
from client_commands import MODEL, TASK, WIDTHS, ask, assert_scores, columns, invoke, rows, run
from engine_server import EngineServer
from rfm_client import (
    FrameScores,
    InferenceFailedError,
    InvalidSampleError,
    ModelInfo,
    PreferenceResult,
    ProgressResult,
    RewardClient,
    Trajectory,
    load_trajectory,
)
from rfm_client.cli import pictures
from rfm_client.cli.comparing import LEGEND, Comparison, compare
from rfm_client.cli.options import PrefixOptions, VideoOptions
from rfm_client.cli.pictures import Panel, plot
from rfm_client.cli.scoring import Source, rule
from rfm_client.command_line import ExitCode
from servers import Served
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
        f"rfm-client: {missing}: video: expected a video file, got none",
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
    assert (first["checkpoint"], first["warning"]) == (MODEL, None)
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
        preference = client.preference(first, second, both_orders=True).preference
    assert compared["preference"] == pytest.approx(preference, abs=TOLERANCE)


def test_compare_asks_both_orders_of_every_two_videos_and_shows_the_scores_of_score(
    served: Served, video: Path, tmp_path: Path
) -> None:
    random = np.random.default_rng(0)
    small, third = tmp_path / "small.npy", tmp_path / "third.npy"
    np.save(small, random.integers(0, 256, (20, 40, 30, 3), np.uint8))
    np.save(third, random.integers(0, 256, (3, 40, 30, 3), np.uint8))
    files = [video, small, third]
    target = tmp_path / "scores.json"
    asked_of = ("--task", TASK, "--url", served.url("grpc"), "--model", MODEL)
    result = invoke("compare", *files, *asked_of, "--json", target)
    told = f"rfm-client: note: {small}: 16 of 20 frames were scored, evenly spaced\n"
    assert (result.exit_code, result.stderr) == (0, told)
    trajectories = [load_trajectory(video, task=TASK, fps=3), *(load_trajectory(f, task=TASK) for f in files[1:])]
    orders = [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)]
    with served.client("grpc", MODEL) as client:
        asked = {order: client.preference(*(trajectories[i] for i in order), subsample=True) for order in orders}
    document = json.loads(target.read_text())
    assert document.keys() & {"first", "second", "preference"} == set()  # which two videos have
    assert [(Path(each["first"]), Path(each["second"])) for each in document["orders"]] == [
        (files[first], files[second]) for first, second in orders
    ]
    told_preferences = [each["preference"] for each in document["orders"]]
    np.testing.assert_allclose(told_preferences, [each.preference for each in asked.values()], rtol=0, atol=TOLERANCE)
    shares = {(a, b): (asked[a, b].preference + 1 - asked[b, a].preference) / 2 for a, b in orders}
    scored = json.loads(invoke("score", *files, *asked_of, "--json", "-").stdout)["videos"]
    for index, each in enumerate(document["videos"]):
        wins = np.mean([share for (a, _), share in shares.items() if a == index])
        assert (each["source"], each["wins"]) == (str(files[index]), pytest.approx(wins, abs=TOLERANCE))
        for name in ("progress", "success"):
            np.testing.assert_allclose(each[name], scored[index][name], rtol=0, atol=TOLERANCE)
        figures = [f"{figure:.4f}" for figure in (each["wins"], each["progress"][-1], each["success"][-1])]
        assert rows(result.stdout, str(files[index]))[0][3:] == [*figures, str(len(each["progress"]))]
    assert document["videos"][1]["frame_indices"] == np.rint(np.linspace(0, 19, 16)).astype(int).tolist()


def test_compare_of_two_videos_has_their_preference_and_verdict(engines: EngineServer, tmp_path: Path) -> None:
    files = [tmp_path / f"{name}.npz" for name in "ab"]
    first, second = (random_trajectory(seed, 3 + seed, *WIDTHS) for seed in range(2))
    for file, seen in zip(files, (first, second), strict=True):
        np.savez(file, video_embeddings=seen.video_embeddings, text_embedding=seen.text_embedding)
    result = ask(engines, "compare", *files, "--json", "-")
    document = json.loads(result.stdout)
    with engines.client(MODEL) as client:
        expected = client.preference(first, replace(second, text_embedding=None), both_orders=True)
        alone = [client.progress(each) for each in (first, replace(second, text_embedding=first.text_embedding))]
    assert document["preference"] == pytest.approx(expected.preference, abs=TOLERANCE)
    assert document["preference"] == document["pairs"][0]["preference"]
    assert_scores(document["first"], alone[0])
    assert_scores(document["second"], alone[1])
    assert (document["verdict"], document["orders_agree"]) == (expected.verdict, expected.orders_agree)
    assert (document["ranking"] is None) == (not expected.orders_agree)


def test_compare_refuses_the_answers_of_two_versions(tmp_path: Path, video: Path) -> None:
    np.save(tmp_path / "small.npy", np.zeros((2, 40, 30, 3), np.uint8))  # of another size: a separate request
    with (
        RewardClient("", transports=[Shelf(after=1)]) as client,
        pytest.raises(InferenceFailedError, match=r"^model_version: expected one for all videos, got 1, 2: ask again$"),
    ):
        compare(client, [str(video), str(tmp_path / "small.npy")], VideoOptions(task=TASK))


@pytest.mark.parametrize(
    ("gives", "remedy"),
    [
        ({}, "compare final progress with rfm-client score"),
        ({"has_progress": False}, "compare remaining seconds at the last frame with rfm-client score"),
        ({"needs_whole_episode": True}, "compare log_prob at the last frame (rfm-client score --json)"),
    ],
)
def test_compare_says_what_to_do_without_a_preference_head(
    video: Path, monkeypatch: pytest.MonkeyPatch, gives: dict[str, bool], remedy: str
) -> None:
    told = "compare: expected a checkpoint with a preference head, got rfm_frames; "
    with RewardClient("", transports=[Shelf(has_preference=False)]) as client:
        info = replace(client.model_info(frames=True), **gives)
        monkeypatch.setattr(client, "model_info", lambda frames: info)
        with pytest.raises(InvalidSampleError, match=f"^{re.escape(told + remedy)}$"):
            compare(client, [str(video)] * 2, VideoOptions(task=TASK))
    assert ("log_prob" in rule([info], PrefixOptions())) == info.needs_whole_episode


def test_a_plot_has_a_strip_for_each_video_and_is_drawn_without_scores_too(tmp_path: Path) -> None:
    told = FrameScores(progress=np.linspace(0, 1, 12, dtype=np.float32), success=np.full(12, np.nan, np.float32))
    frames = np.random.default_rng(0).integers(0, 256, (12, 8, 8, 3), np.uint8)
    panels = [Panel.of("costs $5_$ 漢字", told, frames), Panel.of("[embeddings]", told)]
    plot(tmp_path / "plot.svg", panels, title="both")
    drawn = (tmp_path / "plot.svg").read_text()
    corners = re.findall(r'id="image[^>]* x="([\d.]+)" y="[^"]*" width="([\d.]+)"', drawn)
    middles = np.array([float(x) + float(width) / 2 for x, width in corners])
    np.testing.assert_array_equal(panels[0].strip_positions, [0, 2, 4, 7, 9, 11])
    np.testing.assert_allclose(middles, np.linspace(middles[0], middles[-1], 6), atol=0.2)
    assert (np.diff(middles) >= float(corners[0][1])).all()


SHAPES = {"slide": (1920, 1080), "square": (1080, 1080)}


@pytest.mark.parametrize(("size", "pixels"), SHAPES.items())
def test_a_slide_and_a_square_keep_their_shape_with_any_number_of_videos(
    engines: EngineServer, video: Path, tmp_path: Path, size: Any, pixels: tuple[int, int]
) -> None:
    told = FrameScores(progress=np.linspace(0, 1, 12, dtype=np.float32), success=np.zeros(12, np.float32))
    panel = Panel.of("[frames]", told, np.zeros((12, 8, 8, 3), np.uint8))
    for count in (1, 3):
        plot(tmp_path / "strips.png", [panel] * count, "a title", size=size)
        with Image.open(tmp_path / "strips.png") as strips:
            assert strips.size == pixels or (count > 1 and strips.height > pixels[1])  # with smaller text
            assert strips.width / strips.height == pytest.approx(pixels[0] / pixels[1], abs=1e-3)
    asked = ("--plot", tmp_path / "plot.svg", "--size", size, "--caption", "how it went")
    assert ask(engines, "score", video, "--task", TASK, *asked).exit_code == 0
    drawn = (tmp_path / "plot.svg").read_text()
    width, height = re.findall(r'(?:width|height)="([\d.]+)pt"', drawn)[:2]
    assert float(width) / float(height) == pytest.approx(pixels[0] / pixels[1])
    assert "<!-- how it went -->" in drawn and TASK not in drawn


@pytest.mark.parametrize(
    "positions", [[0, 4.9, 5.1, 10], [0, 0.01, 0.02, 0.03, 9], [*range(10), 9.01, 40], [0, 0.0557, 0.2395], [3]]
)
def test_frames_of_a_strip_are_even_in_time_so_that_none_is_tiny(
    positions: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    times_s = np.array(positions, np.float64)
    scores = FrameScores(progress=np.zeros(len(times_s), np.float32), success=np.zeros(len(times_s), np.float32))
    panel = Panel.of("", scores, np.zeros((len(times_s), 16, 9, 3), np.uint8), times_s)
    assert panel.strip_positions[-1] == times_s[-1]
    assert (np.diff(panel.strip_positions) >= np.ptp(times_s) / 15).all()
    figures: list[Any] = []
    monkeypatch.setattr(pictures, "save", lambda figure, _file: figures.append(figure))
    plot(tmp_path / "strip.png", [panel])
    first, last = figures[0].axes[0].get_xlim()
    assert first <= times_s[0]  # the whole curve is shown
    assert times_s[-1] <= last


def test_without_matplotlib_a_plot_fails_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.style", None)
    scores = FrameScores(progress=np.zeros(1, np.float32), success=np.zeros(1, np.float32))
    with pytest.raises(ImportError, match=r'plots need matplotlib: pip install "\./client\[cli\]"'):
        plot(tmp_path / "plot.svg", [Panel.of("", scores)])


ORDERS: dict[str, tuple[dict[tuple[int, int], float], list[int | None], list[int] | None, list[str]]] = {
    "agree": ({(0, 1): 0.4, (1, 0): 0.9}, [2, 1], [1, 0], ["agree"]),
    "disagree by a hair": ({(0, 1): 0.5001, (1, 0): 0.5001}, [None, None], None, ["no answer"]),
    "both are even": ({(0, 1): 0.5, (1, 0): 0.5}, [None, None], None, ["no answer"]),
    "the third loses to either": (
        {(0, 1): 0.9, (1, 0): 0.9, (0, 2): 0.9, (2, 0): 0.1, (1, 2): 0.8, (2, 1): 0.2},
        [None, None, 3],
        None,
        ["no answer", "agree", "agree"],
    ),
    "of three": (
        {(0, 1): 0.3, (1, 0): 0.9, (0, 2): 0.2, (2, 0): 0.8, (1, 2): 0.6, (2, 1): 0.3},
        [3, 1, 2],
        [1, 2, 0],
        ["agree", "agree", "agree"],
    ),
    "each beats another": (
        {(0, 1): 1.0, (1, 0): 0.0, (0, 2): 0.0, (2, 0): 1.0, (1, 2): 1.0, (2, 1): 0.0},
        [None, None, None],
        None,
        ["agree", "agree", "agree"],
    ),
}


@pytest.mark.parametrize(("preferences", "ranks", "ranking", "answers"), ORDERS.values(), ids=ORDERS)
def test_a_comparison_names_no_winner_where_the_orders_disagree(
    preferences: dict[tuple[int, int], float], ranks: list[int | None], ranking: list[int] | None, answers: list[str]
) -> None:
    scores = ProgressResult(progress=np.zeros(2, np.float32), success=np.zeros(2, np.float32))
    seen = random_trajectory(0, 2, *WIDTHS)
    comparison = Comparison(
        info=ModelInfo(name="rfm", versions=("1",), max_batch_size=64),
        sources=[Source(f"{index}.npz", seen, None) for index in range(len(ranks))],
        scores=[scores] * len(ranks),
        results={
            order: PreferenceResult(preference=each, first=scores, second=scores) for order, each in preferences.items()
        },
    )
    assert (comparison.ranks, comparison.ranking) == (ranks, ranking)
    of_videos, of_pairs, by, *legend = comparison.tables()
    shown = sorted(range(len(ranks)), key=lambda index: -comparison.wins[index])  # rank 3 stands in row 3
    expected = [(f"{index}", f"{index + 1}", str(ranks[index] or "?")) for index in shown]
    assert re.findall(r"^  (\d)\.npz +(\d) +(\S+)", of_videos, re.MULTILINE) == expected
    assert re.findall(r"  (agree|no answer)$", of_pairs, re.MULTILINE) == answers
    assert by == "  rfm compared each video with every other."
    assert legend == [LEGEND] * (ranking is None)
