# SPDX-License-Identifier: MIT
"""Pictures: film strips with score curves. Needs ``rfm-client[cli]``."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from operator import truediv
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rfm_client.contract.results import FRAME_SCORES, SUCCESS_THRESHOLD, FrameScores
from rfm_client.contract.samples import UInt8Array
from rfm_client.plot import BOUNDS, COLOURS, GRID, SCREEN_DPI, THRESHOLD, Canvas, Size, canvas_of, drawing, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ALL_FRAMES = 10  # shown in a strip, if the trajectory has no more
FEW_FRAMES = 6  # shown in a longer trajectory's strip
_LEAST_GAP = 0.7  # between a strip's frames in time, as a share of the mean
WIDTH_IN = 7.0  # page width
COLUMN_WIDTH_IN = 4.8  # width of panels side by side

# inches within a panel
_LEFT, _RIGHT = 0.5, 0.4
_TITLE, _STRIP_GAP, _BELOW = 0.22, 0.1, 0.5
_CURVES, _LEAST_CURVES, _LEAST_PANEL = 1.3, 0.9, 4.3
_HIGHEST_FRAME = 1.2
_FRAME_SHARE = 0.97  # of the room between frames; the rest is a gap
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
    def places(self) -> npt.NDArray[np.float64]:
        """Where the strip's frames stand on the time axis, float64 [S]: evenly spaced, and so only near their times."""
        count = len(self.strip_positions)
        return self.strip_positions if count == 1 else np.linspace(self.positions[0], self.positions[-1], count)

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
        count = len(positions) if len(positions) <= ALL_FRAMES else FEW_FRAMES
        targets = np.linspace(positions[0], positions[-1], count)
        shown = np.unique(np.abs(positions - targets[:, None]).argmin(axis=1))
        gaps = np.diff(positions[shown], append=np.inf)  # after a long gap, the nearest frames may lie together
        shown = shown[gaps > _LEAST_GAP * np.ptp(positions) / count]
        strip = None if frames is None else frames[scored[shown]]
        return cls(title, scores, positions, "frame" if times_s is None else "s", strip, positions[shown])


@dataclass(frozen=True)
class _Layout:
    """What a figure of this width holds besides curves, in inches. columns: panels side by side"""

    panels: Sequence[Panel]
    title: str
    columns: int
    width_in: float

    @property
    def rows(self) -> list[Sequence[Panel]]:
        """The panels that stand side by side."""
        return [self.panels[start : start + self.columns] for start in range(0, len(self.panels), self.columns)]

    @property
    def panel_in(self) -> float:
        """The width of a panel."""
        return self.width_in / self.columns

    @property
    def curves_in(self) -> float:
        """The width of curves and strips."""
        return self.panel_in - _LEFT - _RIGHT

    @property
    def lines(self) -> list[str]:
        """The lines of the title, wrapped."""
        most = int((self.width_in - _LEFT) / _LETTER)
        return [part for line in self.title.splitlines() for part in textwrap.wrap(line, most)]

    @property
    def top_in(self) -> float:
        """The height of the title and the margin."""
        return 0.1 + (_HEADLINE * len(self.lines) + 0.04 if self.lines else 0)

    @property
    def strips_in(self) -> list[float]:
        """The height of each row's highest strip."""
        return [max(_frame_in(panel, self.curves_in)[1] for panel in row) for row in self.rows]

    def curves_high_in(self, height_in: float) -> float:
        """Return the height that is left for the curves of a row."""
        return (height_in - self.top_in - sum(self.strips_in)) / len(self.rows) - _TITLE - _STRIP_GAP - _BELOW

    @classmethod
    def of(cls, panels: Sequence[Panel], title: str, columns: int, size: Size) -> tuple[_Layout, Canvas]:
        """Return the layout for a size, and its canvas. A slide or square has the columns with the largest text."""
        if size == "paper":
            paper = cls(panels, title, columns, columns * (WIDTH_IN if columns == 1 else COLUMN_WIDTH_IN))
            return paper, Canvas(paper.width_in, (_CURVES - paper.curves_high_in(0)) * len(paper.rows), SCREEN_DPI)

        def fits(columns: int, canvas: Canvas) -> bool:
            layout = cls(panels, title, columns, canvas.width_in)
            return layout.panel_in >= _LEAST_PANEL and layout.curves_high_in(canvas.height_in) >= _LEAST_CURVES

        canvas, columns = min((canvas_of(size, partial(fits, each)), each) for each in range(1, len(panels) + 1))
        return cls(panels, title, columns, canvas.width_in), canvas


def plot(
    file: Path, panels: Sequence[Panel], title: str | None = None, *, columns: int = 1, size: Size = "paper"
) -> None:
    """Draw a picture, in the format given by the file suffix: for each panel the scores, and above them some frames.

    columns: panels side by side on paper
    size: as in ``plot_scores``
    """
    layout, canvas = _Layout.of(panels, title or "", columns, size)
    height_in, curves_high_in, top_in = canvas.height_in, layout.curves_high_in(canvas.height_in), layout.top_in
    with drawing() as new_figure:
        figure = new_figure(figsize=(layout.width_in, height_in), dpi=canvas.dpi)

        def axes(left_in: float, top_in: float, height: float, **more: Any) -> Axes:
            bottom_in = height_in - top_in - height
            box = (left_in, bottom_in, layout.curves_in, height)
            whole = (layout.width_in, height_in) * 2
            return figure.add_axes(tuple(map(truediv, box, whole)), **more)

        text = "\n".join(layout.lines)
        figure.text(_LEFT / layout.width_in, 1 - 0.1 / height_in, text, va="top", linespacing=1.5)
        for row, strip_in in zip(layout.rows, layout.strips_in, strict=True):
            below_in = top_in + _TITLE + strip_in + _STRIP_GAP
            for column, panel in enumerate(row):
                left_in = layout.panel_in * column + _LEFT
                curves = axes(left_in, below_in, curves_high_in)
                _draw_curves(curves, panel, curves_high_in)
                if panel.strip is None:
                    curves.set_title(panel.title)
                else:
                    strip = axes(left_in, below_in - _STRIP_GAP - strip_in, strip_in, sharex=curves)
                    _draw_strip(strip, panel, _frame_in(panel, layout.curves_in), layout.curves_in)
                    curves.grid(visible=False, axis="x")
                    for position in panel.strip_positions:
                        curves.axvline(position, **GRID)
            top_in = below_in + curves_high_in + _BELOW
        save(figure, file)


def _frame_in(panel: Panel, curves_in: float) -> tuple[float, float]:
    """Return the width and height in inches of the largest frames that do not overlap."""
    if panel.strip is None:
        return 0.0, 0.0
    height_px, width_px = panel.strip.shape[1:3]
    width_in = min(_HIGHEST_FRAME * width_px / height_px, curves_in / len(panel.strip))
    return width_in, width_in * height_px / width_px


def _draw_strip(axes: Axes, panel: Panel, frame_in: tuple[float, float], curves_in: float) -> None:
    """Draw the frames, joined to their times, and widen the time axis so that none is cut off."""
    assert panel.strip is not None
    (width_in, height_in), (first, last) = frame_in, panel.positions[[0, -1]]
    margin = (last - first) * width_in / (curves_in - width_in) / 2 if last > first else 0.5
    width = width_in / curves_in * (last - first + 2 * margin) * _FRAME_SHARE
    for frame, place, position in zip(panel.strip, panel.places, panel.strip_positions, strict=True):
        axes.imshow(frame, extent=(place - width / 2, place + width / 2, 0, height_in), aspect="auto")
        axes.plot([place, position], [0, -_STRIP_GAP], clip_on=False, **{**GRID, "color": THRESHOLD["color"]})
    strip_in = axes.bbox.height / axes.figure.dpi  # as high as the highest in the row
    axes.set(xlim=(first - margin, last + margin), ylim=(0, strip_in))
    axes.set_title(panel.title, y=height_in / strip_in)
    axes.set_axis_off()


def _draw_curves(axes: Axes, panel: Panel, height_in: float) -> None:
    axes.set_xlabel("time (s)" if panel.unit == "s" else "frame", loc="left")
    if len(panel.positions) == 1:
        axes.set_xticks(panel.positions)
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
            size = 3 if name == "success" else 5  # a dot of progress shows behind an equal one of success
            style: dict[str, Any] = {"color": COLOURS[name], "marker": "o", "markersize": size}
            handles += own.plot(positions, scores[known], label=label, clip_on=False, **style)
            if name == "success":
                handles.append(own.axhline(SUCCESS_THRESHOLD, **THRESHOLD))
    if leading.unit:
        axes.set_ylabel(leading.title(panel.scores.leading))
        axes.set_ylim(bottom=min(0.0, float(np.nanmin(panel.scores.arrays[panel.scores.leading]))))
    if panel.has_second_axis or not leading.unit:
        of_shares.set(ylim=BOUNDS, yticks=(0, 0.5, 1), ylabel="success" if panel.has_second_axis else "")
        of_shares.grid(visible=not panel.has_second_axis, axis="y")
    below = -(_BELOW - 0.14) / height_in
    axes.legend(handles=handles, loc="lower right", bbox_to_anchor=(1, below), ncols=3, borderaxespad=0, borderpad=0)
