# SPDX-License-Identifier: MIT
"""The cost of labels: how long a run took for the frames that it scored."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Cost:
    """The work of the last run that scored frames for a label file.

    A run counts what it scores itself: no frames of earlier runs, and none that another process scored meanwhile. The
    seconds include decoding, but not the loading of the checkpoint.

    frames: rows of the label file; a frame of several cameras counts once
    """

    frames: int
    seconds: float

    @classmethod
    def parse(cls, text: bytes | str | None) -> Cost | None:
        """Return the cost in a label file's metadata; None: it does not say."""
        try:
            told = json.loads(text or b"")
            cost = cls(int(told["frames"]), float(told["seconds"]))
        except (ValueError, TypeError, KeyError, OverflowError):
            return None
        return cost if cost.frames > 0 and cost.seconds > 0 else None

    def json(self) -> bytes:
        """Return the text for the metadata."""
        return json.dumps(asdict(self)).encode()

    @property
    def frames_per_s(self) -> float:
        """Frames of the dataset that were labelled in a second."""
        return self.frames / self.seconds
