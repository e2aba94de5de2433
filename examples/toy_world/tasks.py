# SPDX-License-Identifier: MIT
"""Tasks in the toy world, and the sentences that ask for them."""

from __future__ import annotations

from dataclasses import dataclass

COLOURS = ("red", "green", "blue")
TARGETS = ("bowl", "plate")
VERBS = ("put", "place", "move")
_PREPOSITIONS = {"bowl": "in", "plate": "on"}


@dataclass(frozen=True)
class Task:
    """Put the block with this colour in or on the target, and let go."""

    colour: str
    target: str

    @property
    def block_index(self) -> int:
        """Index into COLOURS for the block."""
        return COLOURS.index(self.colour)

    @property
    def target_index(self) -> int:
        """Index into TARGETS for the target."""
        return TARGETS.index(self.target)

    def sentence(self, verb: str = VERBS[0]) -> str:
        """Return a sentence such as ``put the red block in the bowl``."""
        return f"{verb} the {self.colour} block {_PREPOSITIONS[self.target]} the {self.target}"


TASKS = tuple(Task(colour, target) for colour in COLOURS for target in TARGETS)
