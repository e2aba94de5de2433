# SPDX-License-Identifier: MIT
"""What label files tell: the names of scores, JSON metadata, the cost of a run, the blank cameras by episode."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

from rfm_client import FRAME_SCORES, Float32Array
from rfm_client.frames import BlankFrames
from rfm_labels.datasets.faults import listed

Columns: TypeAlias = dict[str, Float32Array]
PROGRESS, SUCCESS, REMAINING = "progress", "success", "remaining_s"
SCORES = {name: score for name, score in FRAME_SCORES.items() if not score.is_per_bin}  # in the order of columns
BlankCameras: TypeAlias = Mapping[str, Mapping[int, int]]  # highest value of the frames, by camera and episode
BLANK_KEY = b"rfm.blank_cameras"

_MOST_LISTED = 12  # ranges of episodes in a line


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


def skipping_in(names: Iterable[str]) -> str | None:
    """Return the score that is NaN, as progress is, at frames without an answer; None: every frame has an answer."""
    return next((name for name in names if name in SCORES and SCORES[name].skips_frames), None)


def blank_to_metadata(blank: BlankCameras) -> dict[bytes, bytes]:
    """Return label metadata with these blank cameras; empty if there are none."""
    return {BLANK_KEY: json.dumps(blank, sort_keys=True).encode()} if blank else {}


def blank_from_metadata(metadata: Mapping[bytes, bytes] | None) -> BlankCameras:
    """Return the blank cameras from label metadata."""
    stored = json.loads((metadata or {}).get(BLANK_KEY, "{}"))
    return {camera: {int(episode): highest for episode, highest in each.items()} for camera, each in stored.items()}


def blank_lines(blank: BlankCameras, num_episodes: int) -> list[str]:
    """Return one line per camera that is blank in any episode."""
    advice = "its scores mean nothing there; leave out the camera (--cameras) or the episodes (--episodes)"
    told = []
    for camera, highest in blank.items():
        ranges = listed(sorted(highest)).split(",")
        some = ",".join(ranges[:_MOST_LISTED]) + ",..." * (len(ranges) > _MOST_LISTED)
        which = f"{len(highest)} of {num_episodes} episodes ({some})"
        told.append(f"{camera}: {BlankFrames.described(max(highest.values()))}, in {which}: {advice}")
    return told


def canonical_json(document: Any) -> bytes:
    """Return the document as JSON; equal documents give equal bytes."""
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def parsed_object(document: Any) -> dict[str, Any]:
    """Return the object of a JSON text; empty if there is none."""
    try:
        parsed = json.loads(document)
    except (TypeError, ValueError):
        return {}
    return parsed if isinstance(parsed, dict) else {}
