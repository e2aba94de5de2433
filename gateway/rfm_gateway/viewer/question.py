# SPDX-License-Identifier: MIT
"""What the page asks: the fields of its forms."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass

from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.samples import MAX_FRAME_STEPS
from rfm_client.data.orientation import ORIENTATIONS, Orientation
from rfm_client.data.sampling import RULES, Rule, Sampling
from rfm_gateway.body import invalid

DEFAULT_FPS = 3.0  # as rfm-client score has it
_FLAGS = {"true": True, "false": False, "": False}


@dataclass(frozen=True)
class Question:
    """How videos are scored.

    fps: frames a second that are taken of a video
    rule, frames: of each point's prefix; None: as the checkpoint was trained
    resize: frames are made as small as the checkpoint reads them
    orient: how frames are turned before
    """

    task: str
    model: str
    fps: float
    rule: Rule | None
    frames: int | None
    resize: bool
    orient: Orientation

    @classmethod
    def of(cls, fields: Mapping[str, str], default_model: str) -> Question:
        """The question of a form. Raises RequestValidationError for a field that is not allowed."""
        rule = fields.get("sampling") or None
        if rule is not None and rule not in RULES:
            raise invalid(("sampling",), f"expected one of {', '.join(RULES)}, got {reprlib.repr(rule)}")
        if not fields.get("task", "").strip():
            raise invalid(("task",), "expected what is to be done, as a sentence, got none")
        resize = fields.get("resize", "")
        if resize not in _FLAGS:
            raise invalid(("resize",), f"expected true or false, got {reprlib.repr(resize)}")
        orient = next((each for each in ORIENTATIONS if each == (fields.get("orient") or "none")), None)
        if orient is None:
            raise invalid(
                ("orient",), f"expected one of {', '.join(ORIENTATIONS)}, got {reprlib.repr(fields['orient'])}"
            )
        return cls(
            task=fields["task"].strip(),
            model=fields.get("model") or default_model,
            fps=_fps(fields.get("fps") or str(DEFAULT_FPS)),
            rule=rule,
            frames=_frames(fields.get("frames", "").strip()),
            resize=_FLAGS[resize],
            orient=orient,
        )

    def sampling(self, info: ModelInfo) -> Sampling:
        """The rule with its frames. Raises RequestValidationError for a number that the rule does not take."""
        try:
            return Sampling.of(self.rule, self.frames, info.max_frames, trained_padding=info.trained_padding)
        except ValueError as error:
            where, _, message = str(error).partition(": ")
            raise invalid((where,), message) from None


def _fps(text: str) -> float:
    try:
        fps = float(text)
    except ValueError:
        fps = math.nan
    if not 0 < fps < math.inf:
        raise invalid(("fps",), f"expected a number above 0, got {reprlib.repr(text)}")
    return fps


def _frames(text: str) -> int | None:
    if not text:
        return None
    if not (text.isascii() and text.isdecimal() and len(text) < 6 and 0 < int(text) <= MAX_FRAME_STEPS):
        raise invalid(("frames",), f"expected a whole number from 1 to {MAX_FRAME_STEPS}, got {reprlib.repr(text)}")
    return int(text)
