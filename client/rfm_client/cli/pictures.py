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
from rfm_client.plot import BOUNDS, COLOURS, GRID, THRESHOLD, drawing, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ALL_FRAMES = 10  # shown in a strip, if the trajectory has no more
FEW_FRAMES = 6  # shown in a longer trajectory's strip
_LEAST_GAP = 0.7  # between a strip's frames, as a share of the mean: frames that do not overlap then stay readable
WIDTH_IN = 7.0  # page width
COLUMN_WIDTH_IN = 4.8  # width of panels side by side

# inches within a panel
_LEFT, _RIGHT = 0.5, 0.4
_TITLE, _STRIP_GAP, _BELOW = 0.22, 0.06, 0.5
_CURVES = 1.3
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


def plot(file: Path, panels: Sequence[Panel], title: str | None = None, *, columns: int = 1) -> None:
    """Draw a picture, in the format given by the file suffix: for each panel the scores, and above them some frames.

    columns: panels side by side
    """
    panel_in = WIDTH_IN if columns == 1 else COLUMN_WIDTH_IN
    width_in, curves_in = panel_in * columns, panel_in - _LEFT - _RIGHT
    rows = [panels[start : start + columns] for start in range(0, len(panels), columns)]
    strips_in = [max(_frame_in(panel, curves_in)[1] for panel in row) for row in rows]
    most = int((width_in - _LEFT) / _LETTER)
    lines = [part for line in (title or "").splitlines() for part in textwrap.wrap(line, most)]
    top_in = 0.1 + (_HEADLINE * len(lines) + 0.04 if lines else 0)
    height_in = top_in + sum(_TITLE + strip_in + _STRIP_GAP + _CURVES + _BELOW for strip_in in strips_in)
    with drawing() as new_figure:
        figure = new_figure(figsize=(width_in, height_in))

        def axes(left_in: float, top_in: float, height: float, **more: Any) -> Axes:
            bottom_in = height_in - top_in - height
            box = (left_in / width_in, bottom_in / height_in, curves_in / width_in, height / height_in)
            return figure.add_axes(box, **more)

        figure.text(_LEFT / width_in, 1 - 0.1 / height_in, "\n".join(lines), va="top", linespacing=1.5)
        for row, strip_in in zip(rows, strips_in, strict=True):
            below_in = top_in + _TITLE + strip_in + _STRIP_GAP
            for column, panel in enumerate(row):
                left_in = panel_in * column + _LEFT
                curves = axes(left_in, below_in, _CURVES)
                _draw_curves(curves, panel)
                if panel.strip is None:
                    curves.set_title(panel.title)
                else:
                    strip = axes(left_in, below_in - _STRIP_GAP - strip_in, strip_in, sharex=curves)
                    _draw_strip(strip, panel, _frame_in(panel, curves_in), curves_in)
                    curves.grid(visible=False, axis="x")
                    for position in panel.strip_positions:
                        curves.axvline(position, **GRID)
            top_in = below_in + _CURVES + _BELOW
        save(figure, file)


def _frame_in(panel: Panel, curves_in: float) -> tuple[float, float]:
    """Return the width and height in inches of the largest frames that do not overlap at their times."""
    if panel.strip is None:
        return 0.0, 0.0
    height_px, width_px = panel.strip.shape[1:3]
    room_in = curves_in
    if len(panel.strip) > 1:
        nearest = np.diff(panel.strip_positions).min()
        room_in *= nearest / (np.ptp(panel.positions) + nearest)
    width_in = min(_HIGHEST_FRAME * width_px / height_px, room_in)
    return width_in, width_in * height_px / width_px


def _draw_strip(axes: Axes, panel: Panel, frame_in: tuple[float, float], curves_in: float) -> None:
    """Draw the frames at their times, and widen the time axis so that none is cut off."""
    assert panel.strip is not None
    (width_in, height_in), (first, last) = frame_in, panel.positions[[0, -1]]
    margin = (last - first) * width_in / (curves_in - width_in) / 2 if last > first else 0.5
    width = width_in / curves_in * (last - first + 2 * margin) * _FRAME_SHARE
    for frame, position in zip(panel.strip, panel.strip_positions, strict=True):
        axes.imshow(frame, extent=(position - width / 2, position + width / 2, 0, height_in), aspect="auto")
    strip_in = axes.bbox.height / axes.figure.dpi  # as high as the highest in the row
    axes.set(xlim=(first - margin, last + margin), ylim=(0, strip_in))
    axes.set_title(panel.title, y=height_in / strip_in)
    axes.set_axis_off()


def _draw_curves(axes: Axes, panel: Panel) -> None:
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
