# SPDX-License-Identifier: MIT
"""Choose between the two forms of a Qwen3-VL's video prompt in transformers' processor.

The chat template writes a video as vision start, pad, vision end. The processor writes a time, vision start, pads and
vision end for each temporal patch. Before transformers 5.10 (checked: 4.57.6, 5.5.4, 5.9.0) these replace all three
tokens: the form is bare. Since 5.10 (checked: 5.10.1, 5.10.4, 5.24.0) they replace only the pad, so one more vision
start and end remain around the video: the form is wrapped. Images, and videos of Qwen2.5-VL, did not change.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

from rfm.checkpoint.provenance import Assumption
from rfm.family import VideoPrompt

BARE: Final = "bare"
WRAPPED: Final = "wrapped"
WRAPPED_SINCE = (5, 10)  # 5.10.1 is its first published release
_VERSION = re.compile(r"(\d+)\.(\d+)")
_SETTING, _STATED = "video_prompt", "transformers_version"


def decided(
    given: VideoPrompt | None, backbone: Mapping[str, Any], file: str, *, may_be_saved_later: bool = False
) -> tuple[VideoPrompt, tuple[Assumption, ...]]:
    """Return the form of a checkpoint's video prompts, and the form as an assumption if no file proves it.

    given: the caller's option
    backbone: config.json as transformers saved it with the weights; empty: no file of the run is there
    file: its name, for the source
    may_be_saved_later: a later transformers than that of training may have saved the file
    """
    if given is not None:
        return given, ()
    stated = str(backbone.get(_STATED))
    match = _VERSION.match(stated)
    if match is None:
        source = f"default, as no file tells the run's {_STATED}; --video-prompt names the form"
        return BARE, (Assumption(_SETTING, BARE, source),)
    form: VideoPrompt = WRAPPED if (int(match[1]), int(match[2])) >= WRAPPED_SINCE else BARE
    is_assumed = form == WRAPPED and may_be_saved_later
    return form, (Assumption(_SETTING, form, f"{file}: {_STATED} {stated}"),) if is_assumed else ()
