# SPDX-License-Identifier: MIT
"""The shots that the conversations of a batch show, each once, whichever films and conversations they stand in."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from rfm.vlm.batch import FramesOfOneSize, Layout
from rfm.vlm.film import Film, Indices, Shot, SizedFrames, shots_of


@dataclass(eq=False)
class SizedShots:
    """Shots of one size that the vision tower is to read.

    films: uint8 [N, H', W', 3] each
    firsts: of each film, by the id of its sized frames, the first among those of all films
    shots: by key, its frames among those of all films
    """

    films: list[Tensor] = field(default_factory=list)
    firsts: dict[int, int] = field(default_factory=dict)
    shots: dict[Hashable, Shot] = field(default_factory=dict)

    def add(self, sized: SizedFrames, key: Hashable, shot: Shot) -> None:
        """Adds a shot of a film."""
        if id(sized) not in self.firsts:
            self.firsts[id(sized)] = sum(map(len, self.films))
            self.films.append(sized.pixels)
        first = self.firsts[id(sized)]
        places = [int(sized.places[frame]) for frame in shot]
        assert min(places) >= 0  # it is not kept
        self.shots[key] = tuple(first + place for place in places)

    def frames(self) -> FramesOfOneSize:
        """The films, and which of their frames each shot is made of."""
        shots = torch.tensor(list(self.shots.values()))
        is_each = torch.equal(shots, torch.arange(sum(map(len, self.films)))[:, None])
        return FramesOfOneSize(self.films, None if is_each else shots)


class Shots:
    """Finds the shots of a batch.

    are_images: each frame is a shot; else two
    """

    def __init__(self, *, are_images: bool) -> None:
        self._are_images = are_images
        self._of_size: dict[torch.Size, SizedShots] = {}
        self._kept: dict[Hashable, Tensor] = {}
        self._seen: set[Hashable] = set()
        self._sized: list[SizedFrames] = []  # whose ids are taken

    @property
    def sizes(self) -> list[SizedShots]:
        """The shots of each size that are to be read, in the order in which they first came."""
        return list(self._of_size.values())

    def add(self, film: Film, shown: Indices) -> list[Hashable]:
        """The keys of the shots of a conversation that shows these frames of a film."""
        sized, keys = film.ready, []
        self._sized.append(sized)
        for shot in shots_of(shown, are_images=self._are_images):
            key = sized.keys[shot]
            if key not in self._seen:
                self._seen.add(key)
                self._place(sized, key, shot)
            keys.append(key)
        return keys

    def layout(self, tokens_per_shot: Sequence[int]) -> Layout:
        """Where each shot's tokens lie. ``tokens_per_shot``: of each of ``sizes``."""
        made: dict[Hashable, slice] = {}
        start = 0
        for size, tokens in zip(self.sizes, tokens_per_shot, strict=True):
            for key in size.shots:
                made[key] = slice(start, start + tokens)
                start += tokens
        return Layout(made, self._kept)

    def _place(self, sized: SizedFrames, key: Hashable, shot: Shot) -> None:
        if key in sized.kept:
            self._kept[key] = sized.kept[key]
        else:
            self._of_size.setdefault(sized.pixels.shape[1:3], SizedShots()).add(sized, key, shot)
