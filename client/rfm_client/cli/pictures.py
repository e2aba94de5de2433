# SPDX-License-Identifier: MIT
"""Pictures: film strips with score curves. Needs ``rfm-client[cli]``."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rfm_client.contract.results import FRAME_SCORES, SUCCESS_THRESHOLD, FrameScores
from rfm_client.contract.samples import UInt8Array
from rfm_client.plot import BOUNDS, COLOURS, FAINT, GRID, STYLE, THRESHOLD, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ALL_FRAMES = 10  # shown in a strip, if the trajectory has no more
MOST_FRAMES, FEWEST_FRAMES = 8, 5  # shown in a longer trajectory's strip
EVEN_ENOUGH = 1.4  # largest gap between strip frames, as a multiple of the smallest
WIDTH_IN = 7.0  # page width
COLUMN_WIDTH_IN = 4.8  # width of panels side by side

# inches within a panel
_LEFT, _RIGHT = 0.5, 0.1
_SECOND_AXIS = 0.35  # extra space at the right, for success beside a score with a unit
_TITLE, _STRIP_GAP, _BELOW = 0.22, 0.06, 0.5
_CURVES = 1.3
_HIGHEST_FRAME = 1.2
_FRAME_GAP = 0.04
_HEADLINE = 0.17  # a line in the figure's title
_LETTER = 0.08


@dataclass(frozen=True, eq=False)
class Panel:
    """One trajectory's part of a plot: T scored frames, and a strip of S frames, H x W pixels.

    positions: float64 [T], scored frames on the time axis
    unit: ``s`` or ``frame``, for the positions
    strip: uint8 [S, H, W, 3]; None: a trajectory of embeddings
    strip_positions: float64 [S]
    """

    title: str
    scores: FrameScores
    positions: npt.NDArray[np.float64]
    unit: str
    strip: UInt8Array | None
    strip_positions: npt.NDArray[np.float64]

    @property
    def has_second_axis(self) -> bool:
        """True if success has its own axis, because the other score has a unit."""
        return bool(FRAME_SCORES[self.scores.leading].unit) and not np.isnan(self.scores.success).all()

    @classmethod
    def of(
        cls,
        title: str,
        scores: FrameScores,
        frames: UInt8Array | None = None,
        times_s: npt.NDArray[np.float64] | None = None,
    ) -> Panel:
        """Return the panel for a trajectory's scores. It keeps copies of only the frames that it shows.

        frames: uint8 [N, H, W, 3], all N frames that were read; None: embeddings
        times_s: float64 [N], these frames' times; None: unknown
        """
        scored = scores.scored_frames
        positions = scored.astype(np.float64) if times_s is None else times_s[scored]
        shown = _evenly(positions)
        strip = None if frames is None else frames[scored[shown]]
        return cls(title, scores, positions, "frame" if times_s is None else "s", strip, positions[shown])


def _evenly(positions: npt.NDArray[np.float64]) -> npt.NDArray[np.intp]:
    """Return frame indices for a strip: as many as lie evenly spaced, including the first and the last."""
    best, least = np.arange(len(positions)), np.inf
    counts = range(MOST_FRAMES, FEWEST_FRAMES - 1, -1)
    for count in (*[len(positions)] * (len(positions) <= ALL_FRAMES), *counts):
        targets = np.linspace(positions[0], positions[-1], count)
        shown = np.unique(np.abs(positions - targets[:, None]).argmin(axis=1))
        gaps = np.diff(positions[shown])
        ratio = gaps.max() / gaps.min() if len(gaps) else 1.0
        if ratio < least:
            best, least = shown, ratio
        if ratio <= EVEN_ENOUGH:
            break
    return best


def plot(file: Path, panels: Sequence[Panel], title: str | None = None, *, columns: int = 1) -> None:
    """Draw a picture, in the format given by the file suffix: for each panel the scores, and above them some frames.

    title: the first line is bold
    columns: panels side by side
    """
    try:
        import matplotlib.style
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('plots need matplotlib: pip install "./client[cli]"') from error

    rows = [panels[start : start + columns] for start in range(0, len(panels), columns)]
    width_in = WIDTH_IN if columns == 1 else COLUMN_WIDTH_IN
    layouts = [[_Layout.of(panel, width_in) for panel in row] for row in rows]
    heights_in = [max(layout.height_in for layout in row) for row in layouts]
    lines = [] if title is None else _wrapped(title, width_in * columns - _LEFT)
    top_in = 0.1 + (_HEADLINE * len(lines) + 0.04 if lines else 0)
    with matplotlib.style.context([*STYLE]):
        figure = Figure(figsize=(width_in * columns, top_in + sum(heights_in)))
        for number, (line, is_first) in enumerate(lines):
            look: dict[str, Any] = {"weight": "bold"} if is_first else {"color": FAINT}
            y = 1 - (0.1 + _HEADLINE * number) / figure.get_figheight()
            figure.text(_LEFT / figure.get_figwidth(), y, line, va="top", **look)
        for row, own, height_in in zip(rows, layouts, heights_in, strict=True):
            for column, (panel, layout) in enumerate(zip(row, own, strict=True)):
                _draw(_Page(figure, width_in * column + _LEFT, top_in), panel, layout, height_in)
            top_in += height_in
        save(figure, file)


def _wrapped(title: str, width_in: float) -> list[tuple[str, bool]]:
    """Return the title's lines, fitted to the width, and True for those from its first line."""
    most = int(width_in / _LETTER)
    return [(part, not number) for number, line in enumerate(title.splitlines()) for part in textwrap.wrap(line, most)]


@dataclass(frozen=True)
class _Layout:
    """Panel dimensions in inches. limits: time axis limits, so that no frame is cut off."""

    width_in: float
    strip_in: float
    frame_in: float
    limits: tuple[float, float]

    @property
    def height_in(self) -> float:
        return _TITLE + self.strip_in + (_STRIP_GAP if self.strip_in else 0) + _CURVES + _BELOW

    @classmethod
    def of(cls, panel: Panel, panel_in: float) -> _Layout:
        """Return the layout with the widest frames that do not overlap at their times."""
        width_in = panel_in - _LEFT - _RIGHT - (_SECOND_AXIS if panel.has_second_axis else 0)
        first, last = panel.positions[[0, -1]].tolist()
        if panel.strip is None:
            margin = 0.02 * (last - first) or 0.5
            return cls(width_in, 0, 0, (first - margin, last + margin))
        height_px, width_px = panel.strip.shape[1:3]
        most_in = _HIGHEST_FRAME * width_px / height_px
        if first == last:
            frame_in = min(most_in, width_in)
            return cls(width_in, frame_in * height_px / width_px, frame_in, (first - 0.5, last + 0.5))
        nearest = np.diff(panel.strip_positions).min()
        frame_in = min(most_in, width_in * nearest / (last - first + nearest))
        margin = (last - first) * frame_in / (width_in - frame_in) / 2
        return cls(width_in, frame_in * height_px / width_px, frame_in, (first - margin, last + margin))


@dataclass(frozen=True)
class _Page:
    """A figure measured in inches from a point near the top left corner."""

    figure: Figure
    left_in: float
    top_in: float

    def axes(self, left_in: float, top_in: float, width_in: float, height_in: float) -> Axes:
        """Add axes that begin this far right of the point and below it."""
        width, height = self.figure.get_size_inches()
        bottom = 1 - (self.top_in + top_in + height_in) / height
        return self.figure.add_axes(((self.left_in + left_in) / width, bottom, width_in / width, height_in / height))


def _draw(page: _Page, panel: Panel, layout: _Layout, height_in: float) -> None:
    begin, end = layout.limits
    below_in = height_in - _CURVES - _BELOW  # all panels in a row draw their curves at the same height
    axes = page.axes(0, below_in, layout.width_in, _CURVES)
    axes.set_xlim(layout.limits)
    axes.set_xlabel("time (s)" if panel.unit == "s" else "frame", loc="left")
    if len(panel.positions) == 1:
        axes.set_xticks(panel.positions)
    top_in = below_in
    if panel.strip is not None:
        top_in -= layout.strip_in + _STRIP_GAP
        for frame, position in zip(panel.strip, panel.strip_positions, strict=True):
            middle_in = (position - begin) / (end - begin) * layout.width_in
            width_in = layout.frame_in - _FRAME_GAP
            picture = page.axes(middle_in - width_in / 2, top_in, width_in, layout.strip_in)
            picture.imshow(frame, aspect="auto")
            picture.set_axis_off()
            axes.axvline(position, **GRID)
        axes.grid(visible=False, axis="x")
    _draw_curves(axes, panel)
    words = page.axes(0, top_in - _TITLE, layout.width_in, _TITLE)
    words.set_axis_off()
    words.text(0, 0.65, panel.title, va="center")


def _draw_curves(axes: Axes, panel: Panel) -> None:
    leading = FRAME_SCORES[panel.scores.leading]
    of_shares = axes.twinx() if panel.has_second_axis else axes
    handles = []
    for name in (panel.scores.leading, "success"):
        scores, own = panel.scores.arrays[name], of_shares if name == "success" else axes
        if np.isnan(scores).all():
            handles += own.plot([], [], color=COLOURS[name], label=f"{name}: not predicted")
        else:
            label, known = FRAME_SCORES[name].title(name), ~np.isnan(scores)
            positions = np.asarray(panel.positions)[known]
            handles += own.plot(positions, scores[known], color=COLOURS[name], marker="o", label=label, clip_on=False)
            if name == "success":
                label = f"threshold {SUCCESS_THRESHOLD}"
                handles.append(own.axhline(SUCCESS_THRESHOLD, **THRESHOLD, label=label))
    if leading.unit:
        axes.set_ylabel(leading.title(panel.scores.leading))
        axes.set_ylim(bottom=min(0.0, float(np.nanmin(panel.scores.arrays[panel.scores.leading]))))
    if panel.has_second_axis or not leading.unit:
        of_shares.set(ylim=BOUNDS, yticks=(0, 0.5, 1), ylabel="success" if panel.has_second_axis else "")
        of_shares.grid(visible=not panel.has_second_axis, axis="y")
    below = -(_BELOW - 0.14) / _CURVES
    axes.legend(handles=handles, loc="lower right", bbox_to_anchor=(1, below), ncols=3, borderaxespad=0, borderpad=0)
