# SPDX-License-Identifier: MIT
"""Rerun recordings (.rrd) that show frames and scores on one timeline.

Needs ``rfm-client[rerun]``. T frames, H x W pixels.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client.contract.results import FrameScores
from rfm_client.contract.samples import UInt8Array
from rfm_client.transport.threads import Closing

__all__ = ["Recording"]

TIME = "video_time"  # timeline in video seconds
FRAME = "frame"  # timeline in frames, when times are unknown
IMAGE, PROGRESS, SUCCESS = "image", "progress", "success"
JPEG_QUALITY = 90  # as good as the video, at a tenth of the size

_APPLICATION = "rfm-client"
_COLOURS = {PROGRESS: (31, 119, 180), SUCCESS: (44, 160, 44)}  # as in plots


class Recording(Closing):
    """A recording file to which any thread can add trajectories. The first trajectory creates the file.

    A trajectory becomes an entity with ``image``, ``progress`` and ``success``. Scores that the checkpoint does not
    predict are left out.
    """

    def __init__(self, file: Path) -> None:
        """Raise ImportError, naming the extra to install, if the package is missing."""
        try:
            import rerun
        except ImportError as error:
            raise ImportError('recordings need rerun-sdk: pip install "./client[rerun]"') from error
        self._rerun: Any = rerun
        self._file = file
        self._stream: Any = None
        self._lock = threading.Lock()

    def add(
        self,
        name: str,
        scores: FrameScores,
        frames: UInt8Array | None = None,
        times_s: npt.NDArray[np.float64] | None = None,
    ) -> None:
        """Add a trajectory with its scores.

        name: of its entity
        frames: uint8 [T, H, W, 3]; None: embeddings
        times_s: float64 [T], frame times in the video; None: unknown
        """
        curves = {curve: getattr(scores, curve) for curve in _COLOURS if not np.isnan(getattr(scores, curve)).all()}
        with self._lock:
            self._open()
            self._stream.reset_time()  # set by this thread's previous trajectory
            for curve in curves:
                style = self._rerun.SeriesLines(names=curve, colors=_COLOURS[curve])
                self._log([name, curve], style, static=True)
            for index, frame in enumerate(() if frames is None else frames):
                self._set_time(index, times_s)
                self._log([name, IMAGE], self._rerun.Image(frame).compress(jpeg_quality=JPEG_QUALITY))
            for position, index in enumerate(scores.scored_frames.tolist()):
                self._set_time(index, times_s)
                for curve, values in curves.items():
                    if not np.isnan(values[position]):  # else the model gave no answer for the frame
                        self._log([name, curve], self._rerun.Scalars(float(values[position])))

    def close(self) -> None:
        """Flush the recording to the file."""
        if self._stream is not None:
            self._stream.disconnect()

    def _open(self) -> None:
        if self._stream is None:
            self._stream = self._rerun.RecordingStream(_APPLICATION)
            self._stream.save(self._file)

    def _set_time(self, index: int, times_s: npt.NDArray[np.float64] | None) -> None:
        if times_s is None:
            self._stream.set_time(FRAME, sequence=index)
        else:
            self._stream.set_time(TIME, duration=float(times_s[index]))

    def _log(self, entity: list[str], what: Any, *, static: bool = False) -> None:
        self._stream.log(entity, what, static=static, strict=True)  # by default it only warns about errors
