# SPDX-License-Identifier: MIT
"""Which observations of an HDF5 file are a camera's frames, and what is wrong with other pictures. T frames, H x W
pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

CAMERA_FORM = "a camera as uint8 [T, H, W, 3]"

_LEAST_SIZE_PX = 8  # a smaller array of numbers is no picture
_ENCODED = (b"\xff\xd8\xff", b"\x89PNG")  # how JPEG and PNG begin


def pictures_in(demos: Mapping[str, Any]) -> dict[str, str]:
    """All observations that are pictures, each with what keeps it from being a camera in every demonstration, or ""."""
    faults: dict[str, str] = {}
    for demo in demos.values():
        for name, value in demo.get("obs", {}).items():
            if name not in faults and _is_picture(value):
                faults[name] = next(filter(None, (_fault_in(*each, name) for each in demos.items())), "")
    return faults


def fault(value: Any) -> str:
    """What keeps an observation from being a camera's frames; "": nothing."""
    if not hasattr(value, "shape"):
        return "a group: expected its pictures one level up"
    told, shape = _form(value), value.shape
    if _is_encoded(value):
        return f"{told}, JPEG or PNG files: store decoded pictures as uint8 [T, H, W, 3]"
    if len(shape) == 4 and shape[3] == 3 and value.dtype == np.uint8:
        return ""
    if len(shape) == 4 and shape[3] not in (3, 4) and shape[1] in (3, 4):
        return f"{told}, channels first: store it as uint8 [T, H, W, 3]"
    if len(shape) == 4 and shape[3] == 4:
        return f"{told}, RGBA: store its first three channels, if they are uint8 RGB"
    if len(shape) == 4 and shape[3] == 3:
        return f"{told}, not uint8: store colours as 0..255"
    return f"{told}, a depth map, a mask or another form: no colours as uint8 [T, H, W, 3]"


def listed(group: Mapping[str, Any]) -> str:
    """Every observation with its form, for messages."""
    return ", ".join(f"{name} {_form(value)}" for name, value in group.items()) or "none"


def _form(value: Any) -> str:
    return f"{value.dtype} {list(value.shape)}" if hasattr(value, "shape") else "(a group)"


def _fault_in(demo_name: str, demo: Any, name: str) -> str:
    value = demo.get("obs", {}).get(name)
    return f"missing in {demo_name}" if value is None else fault(value)


def _is_picture(value: Any) -> bool:
    """Whether an observation looks like pictures of any form."""
    if not hasattr(value, "shape"):
        return any(_is_picture(each) for each in value.values())
    if len(value.shape) == 3:
        return all(size >= _LEAST_SIZE_PX for size in value.shape[1:])
    return len(value.shape) > 3 or _is_encoded(value)


def _is_encoded(value: Any) -> bool:
    """Whether the observation holds a JPEG or PNG file for each step."""
    if len(value.shape) not in (1, 2) or not value.shape[0] or value.dtype.kind not in "OSVu":
        return False
    return bool(np.asarray(value[0]).tobytes().startswith(_ENCODED))
