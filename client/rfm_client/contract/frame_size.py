# SPDX-License-Identifier: MIT
"""Size to which a served checkpoint resizes frames."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, TypeAlias, cast

Rule: TypeAlias = Literal["shortest", "exact"]

_FORMS = "'shortest PX' or 'exact HEIGHTxWIDTH'"
_TEXT = re.compile(r"(?:(shortest) ([1-9][0-9]*))|(?:(exact) ([1-9][0-9]*)x([1-9][0-9]*))")


@dataclass(frozen=True)
class FrameSize:
    """The size to which a served checkpoint resizes every frame.

    rule: ``shortest`` (ReWiND's encoders): the shorter edge becomes px pixels, the other in proportion, rounded down;
        ``exact``: the frame gets this height and width
    edges_px: (px,), or (height, width) for ``exact``
    """

    rule: Rule
    edges_px: tuple[int, ...]

    @classmethod
    def parse(cls, text: str) -> FrameSize:
        """Parse ``shortest 256`` or ``exact 224x320``, as ``str`` writes them. Raises ValueError."""
        match = _TEXT.fullmatch(text)
        if match is None:
            raise ValueError(f"frame_size: expected {_FORMS}, got {text!r}")
        rule, *edges = (part for part in match.groups() if part)
        return cls(cast(Rule, rule), tuple(map(int, edges)))

    def __str__(self) -> str:
        return f"{self.rule} {'x'.join(map(str, self.edges_px))}"

    def fitted(self, height: int, width: int) -> tuple[int, int]:
        """Return (height, width) to shrink frames of this size to; never larger, since the server enlarges frames."""
        if self.rule == "exact":
            return min(height, self.edges_px[0]), min(width, self.edges_px[1])
        (px,) = self.edges_px
        edge = min(height, width)
        if edge <= px:
            return height, width
        other = int(px * max(height, width) / edge)  # as by the server, which would resize again after other rounding
        return (px, other) if height <= width else (other, px)
