# SPDX-License-Identifier: MIT
"""Pictures: film strips with curves of scores. Needs ``rfm-client[cli]``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rfm_client.contract.results import FRAME_SCORES, FrameScores
from rfm_client.contract.samples import UInt8Array
from rfm_client.plot import save

if TYPE_CHECKING:
    from matplotlib.figure import SubFigure

STRIP_FRAMES = 8
WIDTH_IN = 10.0
COLUMN_WIDTH_IN = 7.0  # of panels side by side
PANEL_HEIGHT_IN = 4.0

_LOOKS = (("tab:blue", "-", "o"), ("tab:green", "--", "s"))  # of progress, or what replaces it, and of success


@dataclass(frozen=True, eq=False)
class Panel:
    """The part of a plot for one trajectory: T scored frames, and a strip of S frames of H x W pixels.

    positions: float64 [T], scored frames on the time axis
    unit: of the positions, ``s`` or ``frame``
    strip: uint8 [S, H, W, 3]; None: a trajectory of embeddings
    strip_positions: float64 [S]
    """

    title: str
    scores: FrameScores
    positions: npt.NDArray[np.float64]
    unit: str
    strip: UInt8Array | None
    strip_positions: npt.NDArray[np.float64]

    @classmethod
    def of(
        cls,
        title: str,
        scores: FrameScores,
        frames: UInt8Array | None = None,
        times_s: npt.NDArray[np.float64] | None = None,
    ) -> Panel:
        """Return the panel of a trajectory's scores. It keeps copies of only the frames that it shows.

        frames: uint8 [N, H, W, 3], all N frames that were read; None: embeddings
        times_s: float64 [N], times of these frames; None: unknown
        """
        scored = scores.scored_frames
        positions = scored.astype(np.float64) if times_s is None else times_s[scored]
        shown = np.unique(np.linspace(0, len(scored) - 1, STRIP_FRAMES).round().astype(int))
        strip = None if frames is None else frames[scored[shown]]
        return cls(title, scores, positions, "frame" if times_s is None else "s", strip, positions[shown])


def plot(file: Path, panels: Sequence[Panel], title: str | None = None, *, columns: int = 1) -> None:
    """Draw a picture, in the format of the file's suffix: for each panel a film strip, below it the scores.

    columns: panels side by side
    """
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('plots need matplotlib: pip install "./client[cli]"') from error

    rows = [panels[start : start + columns] for start in range(0, len(panels), columns)]
    heights_in = [PANEL_HEIGHT_IN * (1 if any(panel.strip is not None for panel in row) else 0.7) for row in rows]
    with matplotlib.rc_context({"text.parse_math": False}):
        figure = Figure(
            figsize=(WIDTH_IN if columns == 1 else COLUMN_WIDTH_IN * columns, sum(heights_in)), layout="constrained"
        )
        if title is not None:
            figure.suptitle(title)
        parts = figure.subfigures(len(rows), columns, squeeze=False, height_ratios=heights_in)
        for part, panel in zip(parts.flat, panels):  # noqa: B905 - the last row may have room left
            _draw(part, panel)
        save(figure, file)


def _draw(part: SubFigure, panel: Panel) -> None:
    columns = len(panel.strip_positions)
    if panel.strip is None:
        axes = part.add_subplot()
    else:
        grid = part.add_gridspec(2, columns, height_ratios=[1, 2])
        for column, (frame, position) in enumerate(zip(panel.strip, panel.strip_positions, strict=True)):
            picture = part.add_subplot(grid[0, column])
            picture.imshow(frame)
            picture.set_axis_off()
            picture.set_title(f"{position:.1f} s" if panel.unit == "s" else f"{position:.0f}", fontsize=8)
        axes = part.add_subplot(grid[1, :])
    leading = FRAME_SCORES[panel.scores.leading]
    of_shares = axes.twinx() if leading.unit and not np.isnan(panel.scores.success).all() else axes
    handles = []
    for (colour, line, marker), name in zip(_LOOKS, (panel.scores.leading, "success"), strict=True):
        scores, own = panel.scores.arrays[name], of_shares if name == "success" else axes
        if np.isnan(scores).all():
            handles += own.plot([], [], color=colour, label=f"{name}: not predicted")
        else:
            label, known = FRAME_SCORES[name].title(name), ~np.isnan(scores)
            handles += own.plot(
                np.asarray(panel.positions)[known],
                scores[known],
                color=colour,
                linestyle=line,
                marker=marker,
                markersize=4,
                label=label,
            )
    axes.set(xlabel="time (s)" if panel.unit == "s" else "frame")
    if leading.unit:
        axes.set(ylabel=leading.title(panel.scores.leading))
    if of_shares is not axes or not leading.unit:
        of_shares.set(ylabel="score", ylim=(-0.02, 1.02))
    axes.grid(alpha=0.3)
    axes.legend(handles=handles, loc="upper left", fontsize=8)
    part.suptitle(panel.title, fontsize=10)
