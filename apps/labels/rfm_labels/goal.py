# SPDX-License-Identifier: MIT
"""The picture of the task done, which Robo-Dopamine reads."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from rfm_client import InvalidSampleError, UInt8Array
from rfm_client.frames import FrameFileError, Picture
from rfm_labels.datasets.stored_files import digest_of
from rfm_labels.options import LAST


@dataclass(frozen=True)
class Goal:
    """A picture of the task done. name: of its file, or ``last``; content: of the file; empty: the last frame"""

    name: str
    content: bytes = field(default=b"", repr=False)

    @classmethod
    def of(cls, given: str) -> Goal:
        """Return the goal of an option. Raises InvalidSampleError for a file that is no picture."""
        if given == LAST:
            return cls(given)
        try:
            goal = cls(Path(given).name, Path(given).read_bytes())
            Picture(goal.content).pixels()
        except FrameFileError as error:
            raise InvalidSampleError.like(error, where="goal") from error
        except OSError as error:
            raise InvalidSampleError.at("goal", f"a picture, or {LAST}", error) from error
        return goal

    def picture(self, frames: UInt8Array) -> UInt8Array:
        """Return the picture, uint8 [H, W, 3], for these frames, uint8 [T, H, W, 3]."""
        return Picture(self.content).pixels() if self.content else frames[-1]

    def document(self) -> dict[str, str]:
        """Return the goal as it stands in the provenance."""
        return {"picture": self.name, **({"digest": digest_of([self.content])} if self.content else {})}
