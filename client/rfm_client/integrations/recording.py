# SPDX-License-Identifier: MIT
"""A Rerun recording (.rrd) of frames and their scores: one timeline, on which curves and video move together.

Needs ``rfm-client[rerun]``; labelled episodes need ``rfm-client[label]``, too. T frames, S of them scored.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rfm_client.contract.results import FrameScores
from rfm_client.contract.samples import UInt8Array
from rfm_client.transport.lifetime import Closing

if TYPE_CHECKING:
    from rfm_client.data.datasets.protocol import Dataset
    from rfm_client.labelling.finished_episodes import Parts
    from rfm_client.labelling.plan import Item, Plan

TIME = "video_time"  # a timeline: seconds of the video
FRAME = "frame"  # or, where they are not known, the number of the frame
IMAGE, PROGRESS, SUCCESS = "image", "progress", "success"
JPEG_QUALITY = 90  # as good as the video, at a tenth of the size

_APPLICATION = "rfm-client"
_COLOURS = {PROGRESS: (31, 119, 180), SUCCESS: (44, 160, 44)}  # as in plots


def load_rerun() -> Any:
    """The package. Raises ImportError, which says how to install it."""
    try:
        import rerun
    except ImportError as error:
        raise ImportError('recordings need rerun-sdk: pip install "./client[rerun]"') from error
    return rerun


class Recording(Closing):
    """A recording file to which trajectories are added, by any threads. The file is made with the first one.

    Each is an entity, which holds ``image``, ``progress`` and ``success``. Scores that the checkpoint does
    not predict are left out.
    """

    def __init__(self, file: Path) -> None:
        """Raises ImportError if the package is missing."""
        self._rerun = load_rerun()
        self._file = file
        self._stream: Any = None
        self._lock = threading.Lock()

    def add(
        self,
        entity: Sequence[str],
        scores: FrameScores,
        videos: Mapping[str, Iterable[UInt8Array]],
        times_s: npt.NDArray[np.float64] | None = None,
    ) -> None:
        """Adds a trajectory with its scores.

        entity: its name, part by part; empty if it is the only one of the file
        videos: T frames, uint8 [H, W, 3], by the camera's name, which is empty if there is only one; none: it is of
            embeddings
        times_s: [T], when each frame is in the video; None: it is not known
        """
        scored = np.arange(len(scores.progress)) if scores.frame_indices is None else scores.frame_indices
        curves = {curve: getattr(scores, curve) for curve in _COLOURS if not np.isnan(getattr(scores, curve)).all()}
        with self._lock:
            self._open()
            self._stream.reset_time()  # of what this thread has added before
            for curve in curves:
                style = self._rerun.SeriesLines(names=curve, colors=_COLOURS[curve])
                self._log((*entity, curve), style, static=True)
            for camera, frames in videos.items():
                for index, frame in enumerate(frames):
                    self._set_time(index, times_s)
                    image = self._rerun.Image(frame).compress(jpeg_quality=JPEG_QUALITY)
                    self._log((*entity, IMAGE, *filter(None, [camera])), image)
            for position, index in enumerate(scored.tolist()):
                self._set_time(index, times_s)
                for curve, values in curves.items():
                    self._log((*entity, curve), self._rerun.Scalars(float(values[position])))

    def close(self) -> None:
        """Writes what is left to the file."""
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

    def _log(self, parts: Sequence[str], what: Any, *, static: bool = False) -> None:
        self._stream.log(list(parts), what, static=static, strict=True)  # or it would only warn of an error


def record_episodes(folder: Path, dataset: Dataset, plan: Plan, parts: Parts) -> Iterator[Path]:
    """The file of each episode of the plan that is labelled, as it is written. The frames are decoded once more.

    Of several cameras each has its frames and its own scores beside the fused ones.
    """
    folder.mkdir(parents=True, exist_ok=True)
    finished = parts.finished(plan.items)
    for item in plan.items:
        if item.key in finished:
            yield _record(folder, dataset, item, parts.read(item), plan.recipe.cameras)


def _record(folder: Path, dataset: Dataset, item: Item, labels: Any, cameras: Sequence[str]) -> Path:
    file = folder / f"episode_{item.episode.index:06d}.rrd"
    with Recording(file) as recording:
        videos = {camera: dataset.frames(item.episode, camera) for camera in cameras}
        recording.add((), _scores(labels, ""), videos if len(videos) > 1 else {"": videos[cameras[0]]})
        for camera in videos if len(videos) > 1 else ():
            recording.add((camera,), _scores(labels, f".{camera}"), {})
    return file


def _scores(labels: Any, suffix: str) -> FrameScores:
    """The columns of a part whose names end so; NaN: not predicted."""
    progress = labels[PROGRESS + suffix].to_numpy()
    name = SUCCESS + suffix
    success = labels[name].to_numpy() if name in labels.column_names else np.full_like(progress, np.nan)
    return FrameScores(progress=progress, success=success)
