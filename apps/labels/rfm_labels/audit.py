# SPDX-License-Identifier: MIT
"""Look for signs that a recording went wrong: what a dataset can hold without contradicting itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rfm_client import UInt8Array
from rfm_client.frames import BlankFrames
from rfm_client.options import counted, first_names
from rfm_labels.datasets.dataset import Dataset, DatasetEpisode
from rfm_labels.datasets.faults import DatasetError, listed, named
from rfm_labels.options import QUIET, Watch
from rfm_labels.outcomes import read_outcomes

MOST_DECODED = 50  # episodes, in pairs of neighbours
_SAME = 1.0  # mean difference of colour values, 0 to 255, that compression may cause
_JUMP = 3.0  # mean difference of two frames in a row that no slow robot causes
_OUTCOMES = ("next.success", "success", "is_success")  # columns


@dataclass(frozen=True)
class Doubt:
    """Something that may be a fault.

    episode, camera: None: of the whole dataset, or of all cameras
    name: the episode's own; None: it has none
    """

    text: str
    episode: int | None = None
    camera: str | None = None
    name: str | None = None

    @classmethod
    def of(cls, text: str, episode: DatasetEpisode, camera: str) -> Doubt:
        """Return a doubt about a camera's frames in an episode."""
        return cls(text, episode.index, camera, episode.own_name)

    def __str__(self) -> str:
        places = [] if self.episode is None else [f"episode {named(self.episode, self.name)}"]
        return ": ".join([*places, *([self.camera] if self.camera else []), self.text])


def doubts_of_files(dataset: Dataset, episodes: Sequence[DatasetEpisode], cameras: Sequence[str]) -> list[Doubt]:
    """Return the doubts that need no decoding."""
    pairs = ((episode, camera) for episode in episodes for camera in cameras)
    return [Doubt.of(text, *pair) for pair in pairs if (text := dataset.doubt(*pair))]


def audit(
    dataset: Dataset, episodes: Sequence[DatasetEpisode], cameras: Sequence[str], watch: Watch = QUIET
) -> list[Doubt]:
    """Return doubts about files, their numbers and outcomes, and about the frames of at most MOST_DECODED episodes.

    Raises RewardError if a frame cannot be decoded.
    """
    doubts = []
    if unused := dataset.unused_files():
        what = f"{counted(len(unused), 'file')} that no episode uses: {first_names(list(map(str, unused)))}"
        doubts.append(Doubt(f"{what}; left from a recording that was written again?"))
    for name in _OUTCOMES:
        try:
            outcomes = read_outcomes(name, getattr(dataset, "file", dataset.root))
        except DatasetError as error:
            if error.where != "outcome":  # else the dataset has no such column
                doubts.append(Doubt(str(error)))
            continue
        if missing := [each.index for each in episodes if outcomes.get(each.index) is None]:
            doubts.append(Doubt(f"{name}: {counted(len(missing), 'episode')} without an outcome: {listed(missing)}"))
    doubts += doubts_of_files(dataset, episodes, cameras)
    chosen = _neighbours(len(episodes))
    watch.checking(len(chosen))
    last: dict[str, UInt8Array] = {}  # last frame by camera, of the episode before
    for place in chosen:
        episode = episodes[place]
        if place - 1 not in chosen:
            last = {}
        for camera in cameras:
            frames = dataset.frames(episode, camera)
            doubts += [Doubt.of(text, episode, camera) for text in _of_frames(frames, camera, last)]
        watch.checked(episode)
    if len(chosen) < len(episodes):
        watch.note(f"audit: frames of {len(chosen)} of {len(episodes)} episodes; choose others with --episodes")
    return doubts


def _neighbours(count: int) -> list[int]:
    """Return the places of all episodes, or of evenly spread pairs."""
    if count <= MOST_DECODED:
        return list(range(count))
    firsts = np.linspace(0, count - 2, MOST_DECODED // 2).astype(int)
    return sorted({place for first in firsts.tolist() for place in (first, first + 1)})


def _of_frames(frames: Iterator[UInt8Array], camera: str, last: dict[str, UInt8Array]) -> list[str]:
    """Return doubts about an episode's frames, uint8 [H, W, 3] each, and keep its last frame in ``last``."""
    shown, before, texts = BlankFrames(), last.pop(camera, None), list[str]()
    first = frame = next(frames)
    shown.add(first)
    is_still = True
    for t, frame in enumerate(frames, 1):
        shown.add(frame)
        if t == 1 and before is not None and before.shape == first.shape:
            same, jump = _difference(first, before), _difference(frame, first)
            if same <= _SAME and jump >= _JUMP:
                texts.append("the first frame equals the last of the episode before, then the picture jumps")
        is_still = is_still and _difference(frame, first) <= _SAME
    last[camera] = frame
    if shown.told:
        texts.append(shown.told)
    elif is_still and frame is not first:
        texts.append("the picture never changes")
    return texts


def _difference(one: UInt8Array, other: UInt8Array) -> float:
    """Return the mean absolute difference of two frames, uint8 [H, W, 3]."""
    return float(np.abs(one.astype(np.int16) - other).mean())
