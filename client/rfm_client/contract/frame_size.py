# SPDX-License-Identifier: MIT
"""To what size a served checkpoint brings frames."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, TypeAlias, cast

Rule: TypeAlias = Literal["shortest", "longest", "exact"]

_FORMS = "'shortest PX', 'longest PX' or 'exact HEIGHTxWIDTH'"
_TEXT = re.compile(r"(?:(shortest|longest) ([1-9][0-9]*))|(?:(exact) ([1-9][0-9]*)x([1-9][0-9]*))")


@dataclass(frozen=True)
class FrameSize:
    """The size to which a served checkpoint brings every frame before it reads it.

    rule: ``shortest``, as ReWiND's encoders: that edge to so many pixels, the other in proportion, rounded down;
        ``longest``, as SmolVLM: that edge, the other in proportion and even;
        ``exact``: height and width
    edges_px: (px,), or (height, width) of ``exact``
    """

    rule: Rule
    edges_px: tuple[int, ...]

    @classmethod
    def parse(cls, text: str) -> FrameSize:
        """The size that ``shortest 256``, ``longest 512`` or ``exact 224x320`` names, as ``str`` writes it. Raises
        ValueError.
        """
        match = _TEXT.fullmatch(text)
        if match is None:
            raise ValueError(f"frame_size: expected {_FORMS}, got {text!r}")
        rule, *edges = (part for part in match.groups() if part)
        return cls(cast(Rule, rule), tuple(map(int, edges)))

    def __str__(self) -> str:
        return f"{self.rule} {'x'.join(map(str, self.edges_px))}"

    def fitted(self, height: int, width: int) -> tuple[int, int]:
        """Height and width to which frames of this size are brought; never larger, so the server does the enlarging."""
        if self.rule == "exact":
            return min(height, self.edges_px[0]), min(width, self.edges_px[1])
        (px,) = self.edges_px
        edge = min(height, width) if self.rule == "shortest" else max(height, width)
        if edge <= px:
            return height, width
        # The same expressions as the server's: with other rounding the server would resize once more.
        if self.rule == "shortest":
            other = int(px * max(height, width) / edge)
            return (px, other) if height <= width else (other, px)
        other = int(px / (width / height)) if width >= height else int(px * (width / height))
        other = max(other + other % 2, 1)
        return (other, px) if width >= height else (px, other)
