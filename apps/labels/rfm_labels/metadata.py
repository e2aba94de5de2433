# SPDX-License-Identifier: MIT
"""Label file metadata: score names, JSON, and which cameras are blank in which episodes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from rfm_client import FRAME_SCORES, Float32Array
from rfm_client.frames import BlankFrames
from rfm_labels.datasets.faults import listed

Columns: TypeAlias = dict[str, Float32Array]
PROGRESS, SUCCESS, REMAINING = "progress", "success", "remaining_s"
SCORES = {name: score for name, score in FRAME_SCORES.items() if not score.is_per_bin}  # in column order
BlankCameras: TypeAlias = Mapping[str, Mapping[int, int]]  # brightest value, by camera and episode
BLANK_KEY = b"rfm.blank_cameras"

_MOST_LISTED = 12  # episode ranges per line


def values_of(column: Any) -> npt.NDArray[Any]:
    """Return a pyarrow column's values, as its ``to_numpy`` does, but without importing pandas for plain numbers."""
    from pyarrow import types

    is_plain = not column.null_count and (types.is_integer(column.type) or types.is_floating(column.type))
    return np.from_dlpack(column.combine_chunks()) if is_plain else column.to_numpy()


def skipping_in(names: Iterable[str]) -> str | None:
    """Return the score that, like progress, is NaN at frames without an answer; None: every frame has an answer."""
    return next((name for name in names if name in SCORES and SCORES[name].skips_frames), None)


def blank_to_metadata(blank: BlankCameras) -> dict[bytes, bytes]:
    """Return label metadata for these blank cameras; empty if there are none."""
    return {BLANK_KEY: json.dumps(blank, sort_keys=True).encode()} if blank else {}


def blank_from_metadata(metadata: Mapping[bytes, bytes] | None) -> BlankCameras:
    """Read the blank cameras from label metadata."""
    stored = json.loads((metadata or {}).get(BLANK_KEY, "{}"))
    return {camera: {int(episode): highest for episode, highest in each.items()} for camera, each in stored.items()}


def blank_lines(blank: BlankCameras, num_episodes: int) -> list[str]:
    """Return one line per camera that is blank in any episode."""
    advice = "its scores mean nothing there; leave out the camera (--cameras) or the episodes (--episodes)"
    lines = []
    for camera, highest in blank.items():
        ranges = listed(sorted(highest)).split(",")
        some = ",".join(ranges[:_MOST_LISTED]) + ",..." * (len(ranges) > _MOST_LISTED)
        which = f"{len(highest)} of {num_episodes} episodes ({some})"
        lines.append(f"{camera}: {BlankFrames.described(max(highest.values()))}, in {which}: {advice}")
    return lines


def canonical_json(document: Any) -> bytes:
    """Serialise the document as JSON; equal documents give equal bytes."""
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def parsed_object(document: Any) -> dict[str, Any]:
    """Parse a JSON object; empty if the text holds no object."""
    try:
        parsed = json.loads(document)
    except (TypeError, ValueError):
        return {}
    return parsed if isinstance(parsed, dict) else {}
