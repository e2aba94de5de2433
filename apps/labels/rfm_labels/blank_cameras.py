# SPDX-License-Identifier: MIT
"""Blank cameras by episode, in label metadata and as lines for the user."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import TypeAlias

from rfm_client.frames import BlankFrames
from rfm_labels.datasets.faults import listed

BlankCameras: TypeAlias = Mapping[str, Mapping[int, int]]  # highest value of the frames, by camera and episode

BLANK_KEY = b"rfm.blank_cameras"

_MOST_LISTED = 12  # ranges of episodes in a line


def by_camera(of_episodes: Iterable[tuple[int, Mapping[str, int]]]) -> BlankCameras:
    """Return the blank cameras of all episodes. of_episodes: episode numbers with the blank cameras of each"""
    found: dict[str, dict[int, int]] = {}
    for episode, blank in of_episodes:
        for camera, highest in blank.items():
            found.setdefault(camera, {})[episode] = highest
    return found


def to_metadata(blank: BlankCameras) -> dict[bytes, bytes]:
    """Return label metadata with these blank cameras; empty if there are none."""
    return {BLANK_KEY: json.dumps(blank, sort_keys=True).encode()} if blank else {}


def from_metadata(metadata: Mapping[bytes, bytes] | None) -> BlankCameras:
    """Return the blank cameras from label metadata."""
    stored = json.loads((metadata or {}).get(BLANK_KEY, "{}"))
    return {camera: {int(episode): highest for episode, highest in each.items()} for camera, each in stored.items()}


def lines(blank: BlankCameras, num_episodes: int) -> list[str]:
    """Return one line per camera that is blank in any episode."""
    advice = "its scores mean nothing there; leave out the camera (--cameras) or the episodes (--episodes)"
    told = []
    for camera, highest in blank.items():
        ranges = listed(sorted(highest)).split(",")
        some = ",".join(ranges[:_MOST_LISTED]) + ",..." * (len(ranges) > _MOST_LISTED)
        which = f"{len(highest)} of {num_episodes} episodes ({some})"
        told.append(f"{camera}: {BlankFrames.described(max(highest.values()))}, in {which}: {advice}")
    return told
