# SPDX-License-Identifier: MIT
"""Ranks, answers of two versions, and plots, without a server."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from client_commands import TASK, WIDTHS
from rfm_client import FrameScores, InferenceFailedError, PreferenceResult, ProgressResult, RewardClient
from rfm_client.cli.comparing import LEGEND, Comparison, compare
from rfm_client.cli.options import VideoOptions
from rfm_client.cli.pictures import Panel, plot
from rfm_client.cli.scoring import Source
from shelves import Shelf
from trajectories import random_trajectory


def test_compare_refuses_the_answers_of_two_versions(tmp_path: Path, video: Path) -> None:
    np.save(tmp_path / "small.npy", np.zeros((2, 40, 30, 3), np.uint8))  # of another size: a separate request
    with (
        RewardClient("", transports=[Shelf(after=1)]) as client,
        pytest.raises(InferenceFailedError, match=r"^model_version: expected one for all videos, got 1, 2: ask again$"),
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
}


@pytest.mark.parametrize(("preferences", "ranks", "ranking", "answers"), ORDERS.values(), ids=ORDERS)
def test_a_comparison_names_no_winner_where_the_orders_disagree(
    preferences: dict[tuple[int, int], float], ranks: list[int | None], ranking: list[int] | None, answers: list[str]
) -> None:
    scores = ProgressResult(progress=np.zeros(2, np.float32), success=np.zeros(2, np.float32))
    seen = random_trajectory(0, 2, *WIDTHS)
    comparison = Comparison(
        [Source(f"{index}.npz", seen, None) for index in range(len(ranks))],
        [scores] * len(ranks),
        {order: PreferenceResult(preference=each, first=scores, second=scores) for order, each in preferences.items()},
    )
    assert (comparison.ranks, comparison.ranking) == (ranks, ranking)
    videos, pairs = ([list(column.cells) for column in shown.wide.columns] for shown in comparison.tables()[:2])
    assert [str(cell) for cell in videos[1]] == [str(ranks[index] or "?") for index in ranking or range(len(ranks))]
    assert [str(cell) for cell in pairs[-1]] == answers
    assert comparison.tables()[2:] == [LEGEND] * (ranking is None)
