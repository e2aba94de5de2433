# SPDX-License-Identifier: MIT
"""Recognise depth maps, masks and the like by camera name."""

from __future__ import annotations

import re

_WORDS = frozenset(
    {"depth", "depths", "disparity", "flow", "instance", "instances", "mask", "masks", "normal", "normals"}
    | {"panoptic", "seg", "segm", "segmentation", "segmentations", "segs", "semantic", "semantics"}
)
_BOUNDS = re.compile(r"[\W\d_]+|(?<=[a-z])(?=[A-Z])")  # between the words of a name


def word_of_no_colours(camera: str) -> str | None:
    """Return the first word in a camera name that means pictures without colours; None without such a word.

    ``depth`` in ``agentview_depth``, ``seg`` in ``seg_instance_id``. Only whole words count: ``segway`` is a camera.
    """
    return next((word for word in map(str.lower, _BOUNDS.split(camera)) if word in _WORDS), None)
