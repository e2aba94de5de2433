# SPDX-License-Identifier: MIT
"""The shots that the conversations of a batch show, each once: images, or temporal groups of two frames of a video.

In dense mode a film's frames stand in many conversations. Whatever the network makes of a shot alone is made once.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from rfm.vlm.batch import FramesOfOneSize
from rfm.vlm.images import FRAMES_PER_GROUP

Indices = npt.NDArray[np.int64]


@dataclass(frozen=True)
class SizedShots:
    """Shots of one size.

    films: uint8 [T, H', W', 3] each
    firsts: of each film, by its id, its first frame among those of all films
    numbers: of each shot, by its frames among those of all films, its number
    """

    films: list[Tensor] = field(default_factory=list)
    firsts: dict[int, int] = field(default_factory=dict)
    numbers: dict[tuple[int, ...], int] = field(default_factory=dict)

    def add(self, film: Tensor, shots: Indices) -> Indices:
        """int64 [S], the numbers of a film's shots, int64 [S, frames of each]."""
        if id(film) not in self.firsts:
            self.firsts[id(film)] = sum(map(len, self.films))
            self.films.append(film)
        of_all = (shots + self.firsts[id(film)]).tolist()
        return np.array([self.numbers.setdefault(tuple(frames), len(self.numbers)) for frames in of_all])

    def frames(self) -> FramesOfOneSize:
        """The films, and which of their frames each shot is made of."""
        shots = torch.tensor(list(self.numbers))
        is_each = torch.equal(shots, torch.arange(sum(map(len, self.films)))[:, None])
        return FramesOfOneSize(self.films, None if is_each else shots)


class Shots:
    """Finds the shots of a batch.

    are_images: each frame is a shot; else two, and an odd count is filled up with the last frame
    """

    def __init__(self, *, are_images: bool) -> None:
        self._are_images = are_images
        self._of_size: dict[torch.Size, SizedShots] = {}

    @property
    def sizes(self) -> list[SizedShots]:
        """The shots of each size, in the order in which they first came."""
        return list(self._of_size.values())

    def add(self, film: Tensor, shown: Indices) -> tuple[int, Indices]:
        """The number of the size of a film's pixels, uint8 [T, H', W', 3], and int64 [S], those of the shots of it.

        shown: int64 [K], the frames that a conversation shows
        """
        size = film.shape[1:3]
        of_size = self._of_size.setdefault(size, SizedShots())
        if self._are_images:
            shots = shown[:, None]
        else:
            filling = shown[-1:].repeat(-len(shown) % FRAMES_PER_GROUP)
            shots = np.concatenate([shown, filling]).reshape(-1, FRAMES_PER_GROUP)
        return list(self._of_size).index(size), of_size.add(film, shots)
