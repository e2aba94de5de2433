# SPDX-License-Identifier: MIT
"""rfm-client score and compare."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import clip
from client_commands import (
    MODEL,
    TASK,
    TOLERANCE,
    WIDTHS,
    ask,
    assert_scores,
    columns,
    invoke,
    rows,
    run,
    web_server,
)
from reference_server import Served
from rfm_client import (
    FrameScores,
    PreferenceResult,
    RewardClient,
    Trajectory,
)
from rfm_client.cli.command import ExitCode
from rfm_client.cli.comparing import LEGEND, Comparison
from rfm_client.cli.options import ServerOptions
from rfm_client.cli.pictures import Panel, plot
from rfm_client.cli.scoring import Source
from rfm_client.data.inputs import load_trajectory
from shelves import Shelf
from trajectories import random_trajectory

MAX_FRAMES = 16  # of that checkpoint


EVENLY = np.rint(np.linspace(0, clip.NUM_FRAMES - 1, MAX_FRAMES)).astype(int)


def test_score_writes_what_the_client_gives_and_one_bad_video_does_not_stop_the_others(
    served: Served, video: Path, tmp_path: Path
) -> None:
    embeddings = tmp_path / "embeddings.npz"
    seen = random_trajectory(3, 5, *WIDTHS)
    np.savez(embeddings, video_embeddings=seen.video_embeddings, text_embedding=seen.text_embedding)
    missing = tmp_path / "missing.mp4"
    target = tmp_path / "scores.json"
    plotted = tmp_path / "plot.png"
    result = run(
        *("score", video, missing, embeddings, "--task", TASK, "--fps", 10, "--model", MODEL),
        *("--json", target, "--npy", tmp_path / "arrays", "--plot", plotted),
        RFM_URL=f"{served.url('http')} {served.url('grpc')}",
    )
    assert result.returncode == ExitCode.FAILED
    assert sorted(result.stderr.splitlines()) == sorted(  # as they are done
        [
            f"rfm-client: note: {video}: 16 of 32 frames were scored, evenly spaced",
            f"rfm-client: {missing}: video: expected a file with a video stream, got No such file or directory",
        ]
    )
    with served.client("http", MODEL) as client:
        filmed = client.progress(load_trajectory(video, task=TASK, fps=10), subsample=True)
        embedded = client.progress(seen)

    document = json.loads(target.read_text())
    assert document["servers"] == [served.url("http"), served.url("grpc")]
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

    assert sorted(file.name for file in (tmp_path / "arrays").iterdir()) == ["clip.npy", "embeddings.npy"]
    array = np.load(tmp_path / "arrays" / "clip.npy")
    assert array.dtype == np.float32
    np.testing.assert_array_equal(array, np.float32([first["progress"], first["success"]]).T)
    assert plotted.read_bytes().startswith(b"\x89PNG")


OPTIONS: dict[str, tuple[list[object], dict[str, Any]]] = {
    "as it is": ([], {"subsample": True}),
    "dense": (["--frame-steps", 4], {"frame_steps": 4}),
    "resized": (["--resize"], {"subsample": True, "resize": True}),
}


@pytest.mark.parametrize(("words", "options"), OPTIONS.values(), ids=OPTIONS)
def test_score_passes_its_options_on(served: Served, video: Path, words: list[object], options: dict[str, Any]) -> None:
    result = ask(served, "score", video, "--task", TASK, *words, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    (scored,) = json.loads(result.stdout)["videos"]  # and nothing but JSON
    with served.client("grpc", MODEL) as client:
        expected = client.progress(load_trajectory(video, task=TASK, fps=3.0), **options)
    assert_scores(scored, expected)
    np.testing.assert_allclose(scored["frame_times_s"], np.linspace(0, 31, 10).astype(int) / clip.FPS)


def test_score_and_compare_turn_frames_as_they_are_told(served: Served, video: Path, tmp_path: Path) -> None:
    upright, stored = load_trajectory(video, fps=3.0).frames, tmp_path / "upside_down.npy"
    assert upright is not None
    np.save(stored, upright[:, ::-1])
    asked = ("--task", TASK, "--orient", "flip-vertical", "--json")
    told = json.loads(ask(served, "score", stored, *asked).stdout)
    compared = json.loads(ask(served, "compare", stored, video, *asked).stdout)
    assert told["orient"] == compared["orient"] == "flip-vertical"
    first, second = (Trajectory(frames=frames, task=TASK) for frames in (upright, upright[:, ::-1]))
    with served.client("grpc", MODEL) as client:
        expected = client.progress(first)
        preference = client.preference(first, second).preference
        assert not np.allclose(expected.progress, client.progress(second).progress, atol=100 * TOLERANCE)
    assert_scores(told["videos"][0], expected)
    assert compared["preference"] == pytest.approx(preference, abs=TOLERANCE)


@pytest.mark.parametrize("limit", [4, 24])
def test_score_takes_at_most_as_many_frames_as_it_is_told_and_the_checkpoint_reads(
    served: Served, video: Path, limit: int
) -> None:
    result = ask(served, "score", video, "--task", TASK, "--fps", 10, "--max-frames", limit, "--json", "-")
    (scored,) = json.loads(result.stdout)["videos"]
    indices = np.rint(np.linspace(0, clip.NUM_FRAMES - 1, min(limit, MAX_FRAMES))).astype(int)
    assert scored["frame_indices"] == indices.tolist()
    frames = load_trajectory(video, fps=10).frames
    assert frames is not None
    with served.client("grpc", MODEL) as client:
        assert_scores(scored, client.progress(Trajectory(frames=frames[indices], task=TASK)))


def test_score_leaves_no_frame_out_if_told_so(served: Served, video: Path) -> None:
    result = ask(served, "score", video, "--task", TASK, "--fps", 10, "--no-subsample")
    assert result.exit_code == ExitCode.FAILED
    assert result.stderr.startswith(f"rfm-client: {video}: num_frames: expected at most 16")
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""


def test_score_reads_videos_behind_urls(served: Served, video: Path) -> None:
    with web_server(video.parent) as url:
        result = ask(served, "score", f"{url}/clip.mp4", video, "--task", TASK, "--json", "-")
    remote, local = json.loads(result.stdout)["videos"]
    np.testing.assert_allclose(remote["progress"], local["progress"], rtol=0, atol=TOLERANCE)
    assert remote["frame_times_s"] is None


def test_score_writes_one_video_to_a_file(served: Served, video: Path, tmp_path: Path) -> None:
    result = ask(served, "score", video, "--task", TASK, "--npy", tmp_path / "rewards.npy")
    assert result.exit_code == 0, result.stderr
    assert np.load(tmp_path / "rewards.npy").shape == (10, 2)


def test_a_task_that_is_missing_is_told(served: Served, video: Path) -> None:
    result = ask(served, "score", video)
    assert result.exit_code == ExitCode.FAILED
    mend = 'add --task "what is to be done"'
    assert result.stderr == f"rfm-client: {video}: task: expected a sentence with frames, got none: {mend}\n"
    compared = ask(served, "compare", video, video)
    assert compared.exit_code == ExitCode.FAILED
    assert mend in compared.stderr


def test_compare_asks_both_orders_of_two_videos_also_of_two_sizes(served: Served, video: Path, tmp_path: Path) -> None:
    small = tmp_path / "small.npy"
    np.save(small, np.random.default_rng(0).integers(0, 256, (20, 40, 30, 3), np.uint8))
    target, picture = tmp_path / "scores.json", tmp_path / "both.pdf"
    result = ask(served, "compare", video, small, "--task", TASK, "--json", target, "--plot", picture)
    told = f"rfm-client: note: {small}: 16 of 20 frames were scored, evenly spaced\n"
    assert (result.exit_code, result.stderr) == (0, told)
    first, second = load_trajectory(video, task=TASK, fps=3), load_trajectory(small)
    with served.client("grpc", MODEL) as client:
        expected = client.preference(first, second, subsample=True)
        swapped = client.preference(replace(second, task=TASK), first, subsample=True).preference
    document = json.loads(target.read_text())
    assert document["preference"] == pytest.approx(expected.preference, abs=TOLERANCE)
    assert_scores(document["first"], expected.first)
    assert_scores(document["second"], expected.second)
    assert document["second"]["frame_indices"] == np.rint(np.linspace(0, 19, 16)).astype(int).tolist()
    assert document["orders"] == [
        {"first": str(video), "second": str(small), "preference": document["preference"]},
        {"first": str(small), "second": str(video), "preference": pytest.approx(swapped, abs=TOLERANCE)},
    ]
    both = (document["preference"] + 1 - document["orders"][1]["preference"]) / 2
    wins = {str(video): both, str(small): 1 - both}
    agree = (document["preference"] > 0.5) == (swapped < 0.5)
    verdict = ("first" if expected.preference > 0.5 else "second") if agree else None
    assert (document["verdict"], document["orders_agree"]) == (verdict, agree)
    assert (document["ranking"] is None) == (not agree)
    for name, each in zip(wins, document["videos"], strict=True):
        assert (each["source"], each["wins"]) == (name, pytest.approx(wins[name]))
        row = rows(result.stdout, name)[0]
        figures = (wins[name], each["progress"][-1], each["success"][-1])
        assert row[2:] == [*(f"{figure:.4f}" for figure in figures), str(len(each["progress"]))]
    assert picture.read_bytes().startswith(b"%PDF")


def test_compare_ranks_several_videos_by_both_orders_of_every_two(served: Served, tmp_path: Path) -> None:
    files = [tmp_path / f"{name}.npz" for name in "abc"]
    trajectories = [random_trajectory(seed, 3 + seed, *WIDTHS) for seed in range(3)]
    for file, seen in zip(files, trajectories, strict=True):
        np.savez(file, video_embeddings=seen.video_embeddings, text_embedding=seen.text_embedding)
    target = tmp_path / "scores.json"
    result = ask(served, "compare", *files, "--json", target, "--plot", tmp_path / "all.svg")
    assert (result.exit_code, result.stderr) == (0, "")
    asked = [replace(seen, text_embedding=trajectories[0].text_embedding) for seen in trajectories]
    orders = [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)]
    with served.client("grpc", MODEL) as client:
        told = {order: client.preference(*(asked[index] for index in order)) for order in orders}
    document = json.loads(target.read_text())
    assert document.keys() & {"first", "second", "preference"} == set()
    assert document["orders"] == [
        {
            "first": str(files[first]),
            "second": str(files[second]),
            "preference": pytest.approx(told[first, second].preference, abs=TOLERANCE),
        }
        for first, second in orders
    ]
    wins = [
        np.mean([(told[a, b].preference + 1 - told[b, a].preference) / 2 for b in range(3) if b != a]) for a in range(3)
    ]
    assert [each["source"] for each in document["videos"]] == list(map(str, files))
    for index, each in enumerate(document["videos"]):
        assert each["wins"] == pytest.approx(wins[index], abs=TOLERANCE)
        assert_scores(each, told[0, 1].first if index == 0 else told[0, index].second)
    pairs = [line for line in result.stdout.splitlines() if line.rstrip().endswith((" agree", " no answer"))]
    for line, (first, second), pair in zip(pairs, [(0, 1), (0, 2), (1, 2)], document["pairs"], strict=True):
        answers = told[first, second].preference, 1 - told[second, first].preference
        agree = (answers[0] > 0.5) == (answers[1] > 0.5)
        shown = [f"{share:.4f}" for share in (*answers, sum(answers) / 2)]
        orders = "agree" if agree else "no answer"
        assert columns(line, str(files[first])) == [str(files[first]), str(files[second]), *shown, orders]
        verdict = ("first" if answers[0] > 0.5 else "second") if agree else None
        assert pair == {
            "first": str(files[first]),
            "second": str(files[second]),
            "verdict": verdict,
            "orders_agree": agree,
        }
    assert (tmp_path / "all.svg").read_text().startswith("<?xml")


ORDERS: dict[str, tuple[dict[tuple[int, int], float], list[int | None], list[int] | None, list[str]]] = {
    "agree": ({(0, 1): 0.4, (1, 0): 0.9}, [2, 1], [1, 0], ["agree"]),
    "disagree by a hair": (
        {(0, 1): 0.5001, (1, 0): 0.5001},
        [None, None],
        None,
        ["no answer"],
    ),
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
}


@pytest.mark.parametrize(("preferences", "ranks", "ranking", "answers"), ORDERS.values(), ids=ORDERS)
def test_a_comparison_names_no_winner_where_the_orders_disagree(
    preferences: dict[tuple[int, int], float],
    ranks: list[int | None],
    ranking: list[int] | None,
    answers: list[str],
) -> None:
    scores = FrameScores(progress=np.zeros(2, np.float32), success=np.zeros(2, np.float32))
    seen = random_trajectory(0, 2, *WIDTHS)
    comparison = Comparison(
        [Source(f"{index}.npz", seen, None) for index in range(len(ranks))],
        {order: PreferenceResult(preference=each, first=scores, second=scores) for order, each in preferences.items()},
    )
    assert (comparison.ranks, comparison.ranking) == (ranks, ranking)
    videos, pairs = ([list(column.cells) for column in shown.columns] for shown in comparison.tables()[:2])
    assert [str(cell) for cell in videos[1]] == [str(ranks[index] or "?") for index in ranking or range(len(ranks))]
    assert [str(cell) for cell in pairs[-1]] == answers
    assert comparison.tables()[2:] == [LEGEND] * (ranking is None)


def test_compare_refuses_the_answers_of_two_versions(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, video: Path
) -> None:
    np.save(tmp_path / "small.npy", np.zeros((2, 40, 30, 3), np.uint8))  # of another size: a request of its own
    client = RewardClient("", transports=[Shelf(after=1)])
    monkeypatch.setattr(ServerOptions, "connected", lambda _server, _access: client)
    result = invoke("compare", video, tmp_path / "small.npy", "--task", TASK, "--url", "grpc://127.0.0.1:1")
    assert (result.exit_code, result.stdout) == (ExitCode.FAILED, "")
    assert result.stderr == "rfm-client: model_version: expected one for all videos, got 1, 2: ask again\n"


def test_compare_tells_what_cannot_be_compared(served: Served, video: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "embeddings.npy", np.zeros((2, 8), np.float32))
    result = ask(served, "compare", video, tmp_path / "embeddings.npy", "--task", TASK)
    assert result.exit_code == ExitCode.FAILED
    expected = "second: expected frames, as the first trajectory, got video_embeddings"
    assert result.stderr == f"rfm-client: {video} and {tmp_path / 'embeddings.npy'}: {expected}\n"


def test_a_lerobot_file_of_several_episodes_is_neither_scored_nor_compared(
    served: Served, video: Path, tmp_path: Path
) -> None:
    film = tmp_path / "videos" / "observation.images.top" / "chunk-000" / "file-000.mp4"
    film.parent.mkdir(parents=True)
    film.write_bytes(video.read_bytes())
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text('{"codebase_version": "v3.0", "total_episodes": 10}')
    refused = (
        "video: expected a film of one episode, got a LeRobot v3.0 file that holds 10 episodes: label the dataset "
    )
    for words in (("score", film), ("compare", video, film)):
        result = ask(served, *words, "--task", TASK)
        assert (result.exit_code, result.stdout) == (ExitCode.FAILED, "")
        assert refused in result.stderr
        assert str(film) in result.stderr


def test_a_plot_has_a_strip_for_each_video_and_is_drawn_without_scores_too(tmp_path: Path) -> None:
    told = FrameScores(progress=np.linspace(0, 1, 12, dtype=np.float32), success=np.full(12, np.nan, np.float32))
    frames = np.random.default_rng(0).integers(0, 256, (12, 8, 8, 3), np.uint8)
    panels = [Panel.of("costs $5_$ 漢字", told, frames), Panel.of("[embeddings]", told)]
    plot(tmp_path / "plot.svg", panels, title="both")
    drawn = (tmp_path / "plot.svg").read_text()
    assert drawn.count("<image") == 8
