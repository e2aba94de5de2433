# SPDX-License-Identifier: MIT
"""Cameras of a dataset by name: the corrections that a caller asks for, and names that mean no colours."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rfm_client.frames import ChannelOrder, Correction, Orientation
from rfm_client.options import ConfigError
from rfm_labels.datasets.faults import DatasetError

LEAST_SIZE_PX = 8  # of a side; a smaller array of numbers is no picture
_WORDS = frozenset(
    {"depth", "depths", "disparity", "flow", "instance", "instances", "mask", "masks", "normal", "normals"}
    | {"panoptic", "seg", "segm", "segmentation", "segmentations", "segs", "semantic", "semantics"}
)
_BOUNDS = re.compile(r"[\W\d_]+|(?<=[a-z])(?=[A-Z])")  # between the words of a name
_CAMERA_PREFIX = "observation.images."


def word_of_no_colours(camera: str) -> str | None:
    """Return the first word in a camera name that means pictures without colours; None without such a word.

    ``depth`` in ``agentview_depth``, ``seg`` in ``seg_instance_id``. Only whole words count: ``segway`` is a camera.
    """
    return next((word for word in map(str.lower, _BOUNDS.split(camera)) if word in _WORDS), None)


def camera_named(name: str, cameras: Sequence[str]) -> str | None:
    """Return the camera of this name, which may omit LeRobot's ``observation.images.``; None: there is none."""
    return next((known for known in cameras if known in (name, _CAMERA_PREFIX + name)), None)


def parsed_by_camera(option: str, texts: Iterable[str]) -> dict[str, Any]:
    """Parse values of an option of corrections, such as ``rotate180``, or ``agentview_rgb=rotate180`` for one camera.

    The name of a value for all other cameras is empty. Raises ConfigError.
    """
    found: dict[str, Any] = {}
    for text in texts:
        camera, _, value = text.rpartition("=")
        if camera in found:
            raise ConfigError.at(option, "each camera once", f"{text!r} again")
        found[camera] = value
    for value in found.values():
        Correction(**{option: value})  # raises ConfigError
    return found


@dataclass(frozen=True)
class AskedCorrections:
    """Corrections that the caller asks for, by camera. The name of a value for all other cameras is empty."""

    orient: Mapping[str, Orientation] = field(default_factory=dict)
    channels: Mapping[str, ChannelOrder] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        orient: Orientation | Mapping[str, Orientation] | None,
        channels: ChannelOrder | Mapping[str, ChannelOrder] | None,
    ) -> AskedCorrections:
        """Return values for all cameras, or by camera; None: not given. Raises DatasetError for an unknown value."""
        asked = cls(
            {"": orient} if isinstance(orient, str) else orient or {},
            {"": channels} if isinstance(channels, str) else channels or {},
        )
        try:
            for turn in asked.orient.values():
                Correction(orient=turn)
            for order in asked.channels.values():
                Correction(channels=order)
        except ConfigError as error:
            raise DatasetError.like(error) from None
        return asked

    def of_cameras(
        self,
        cameras: Sequence[str],
        turns: Mapping[str, Orientation] | None = None,
        orders: Mapping[str, ChannelOrder] | None = None,
    ) -> Mapping[str, Correction]:
        """Return the correction of each camera whose frames change. Raises DatasetError for an unknown camera.

        turns: orientations of cameras for which the caller gives none
        orders: orders of colours of cameras for which the caller gives none
        """
        orient = {**({} if "" in self.orient else turns or {}), **_known("orient", self.orient, cameras)}
        channels = {
            **({} if "" in self.channels else orders or {}),
            **_known("channels", self.channels, cameras),
        }
        found = {camera: Correction.of(camera, orient, channels) for camera in cameras}
        return {camera: correction for camera, correction in found.items() if correction != Correction()}


def _known(option: str, asked: Mapping[str, Any], cameras: Sequence[str]) -> dict[str, Any]:
    """Return the value of each camera for which one is asked. Raises DatasetError for an unknown camera."""
    found = dict.fromkeys(cameras, asked[""]) if "" in asked else {}
    for name, value in asked.items():
        camera = camera_named(name, cameras)
        if camera is not None:
            found[camera] = value
        elif name:
            raise DatasetError.at(option, f"one of the cameras {', '.join(cameras)}", repr(name))
    return found
