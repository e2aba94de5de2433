# SPDX-License-Identifier: MIT
"""Figures of several results."""

from __future__ import annotations

import re

import numpy as np
import pytest
from matplotlib.colors import to_hex

from paths import ROOT
from rfm_client import FrameScores
from rfm_client.plot import plot_scores


def scores(num_frames: int, *, success: float = 0.5, frame_indices: list[int] | None = None) -> FrameScores:
    return FrameScores(
        progress=np.linspace(0, 1, num_frames, dtype=np.float32),
        success=np.full(num_frames, success, np.float32),
        frame_indices=None if frame_indices is None else np.array(frame_indices),
    )


def test_every_result_has_a_curve_of_progress_in_one_axes_and_of_success_below() -> None:
    results = [scores(4), scores(3, frame_indices=[0, 5, 10])]
    figure = plot_scores(results, ["a_$1.mp4", "b" * 60], title='"stack the cups"')
    progress, success = figure.axes
    for ax, name in ((progress, "progress"), (success, "success")):
        assert ax.get_ylabel() == name
        for line, result in zip(ax.get_lines(), results, strict=False):  # the threshold follows
            np.testing.assert_array_equal(line.get_ydata(), getattr(result, name))
    np.testing.assert_array_equal(progress.get_lines()[1].get_xdata(), [0, 5, 10])
    assert [line.get_marker() for line in progress.get_lines()] == ["o", "o"]
    assert [line.get_linestyle() for line in progress.get_lines()] == ["-", "--"]  # tell equal curves apart
    assert success.get_xlabel() == "frame"
    assert figure.get_suptitle() == '"stack the cups"'
    told = [text.get_text() for text in figure.legends[0].get_texts()]
    assert told == ["a_$1.mp4", f"{'b' * 21}…{'b' * 22}", "success if last ≥ 0.5"]


def test_seconds_stand_on_the_axis_if_all_are_known_and_success_only_if_predicted() -> None:
    results = [scores(2, success=np.nan), scores(2, success=np.nan)]
    times_s = [np.array([0.0, 0.5]), np.array([0.0, 0.25])]
    (ax,) = plot_scores(results, ["a", "b"], times_s=times_s).axes
    assert ax.get_xlabel() == "time (s)"
    np.testing.assert_array_equal(ax.get_lines()[1].get_xdata(), [0, 0.25])
    (ax,) = plot_scores(results, ["a", "b"], times_s=[times_s[0], None]).axes
    assert ax.get_xlabel() == "frame"


def test_a_model_of_remaining_seconds_has_an_axis_in_seconds_beside_that_of_progress() -> None:
    nothing = np.full(3, np.nan, np.float32)
    seconds = FrameScores(progress=nothing, success=nothing, remaining_s=np.array([30, 12, 1], np.float32))
    figure = plot_scores([seconds, scores(2)], ["a", "b"])
    of_seconds, progress, success = figure.axes
    assert [ax.get_ylabel() for ax in (of_seconds, progress, success)] == ["remaining (s)", "progress", "success"]
    (line,) = of_seconds.get_lines()
    np.testing.assert_array_equal(line.get_ydata(), [30, 12, 1])
    assert of_seconds.get_ylim()[1] > 30
    assert len(progress.get_lines()) == 1
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a", "b", "success if last ≥ 0.5"]


def test_the_colours_are_those_of_the_page_and_no_axes_are_boxed() -> None:
    light = (ROOT / "apps" / "page" / "rfm_page" / "static" / "page.css").read_text().partition("@media")[0]
    colours = re.findall(r"--curve-\d+: (#\w{6})", light)
    assert len(colours) >= 8
    figure = plot_scores([scores(3)] * len(colours), [f"{index}" for index in range(len(colours))])
    for ax in figure.axes:
        drawn = [to_hex(line.get_color()) for line in ax.get_lines() if len(line.get_xdata()) == 3]
        assert drawn == colours
        assert not ax.spines["top"].get_visible() and not ax.spines["right"].get_visible()


@pytest.mark.parametrize(
    ("num_results", "num_names", "message"),
    [(41, 41, "results: expected 1 to 40, got 41"), (1, 0, "names: expected 1, as many as results, got 0")],
)
def test_plots_of_too_many_results_or_too_few_names_are_refused(num_results: int, num_names: int, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}$"):
        plot_scores([scores(2)] * num_results, ["a"] * num_names)
