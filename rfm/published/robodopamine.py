# SPDX-License-Identifier: MIT
"""Read Robo-Dopamine: an ordinary Qwen-VL that only its name identifies."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from rfm.config import CheckpointConfig
from rfm.families.robodopamine.checkpoint import RoboDopamineCheckpoint
from rfm.families.robodopamine.prompts import RoboDopamineConfig
from rfm.files import CheckpointError
from rfm.published.language import ANY_QWEN, LanguageFolder, is_ours, reopened, stops_of
from rfm.published.provenance import Assumption
from rfm.published.reader import Loaded, Reader, settings_asked
from rfm.qwen.processor import pixel_limits, read_processor
from rfm.saved import is_saved

_NAME = RoboDopamineConfig.reward_model
_USER_SETTINGS: dict[str, type] = {"mode": str, "interval": int}  # settings that ``--as`` takes


def load(folder: Path, options: CheckpointConfig) -> Loaded:
    """Load the model from a local folder: a Qwen-VL's, or an export. Raises CheckpointError."""
    if options.video_prompt is not None:
        expected = "none: the prompt of this checkpoint has images"
        raise CheckpointError.at("--video-prompt", expected, options.video_prompt)
    given = settings_asked(options, _USER_SETTINGS)
    assumptions: tuple[Assumption, ...] = ()
    if is_saved(folder):
        checkpoint = reopened(RoboDopamineCheckpoint, folder, options)
    else:
        files = LanguageFolder.read(folder, options, ANY_QWEN)
        _, preprocessor = read_processor(files.processor)
        limits = pixel_limits(preprocessor, f"base model {files.processor}")
        config = RoboDopamineConfig(**{**files.made_of, **limits}, stops=stops_of(folder))
        assumptions = files.assumed_but("video_prompt")
        checkpoint = RoboDopamineCheckpoint(config, files.weights, files.processor)
    config = replace(checkpoint.config, **given)
    config.check()
    checkpoint = replace(checkpoint, config=config)
    checkpoint.check()
    return Loaded(checkpoint, assumptions)


READER = Reader(partial(is_ours, _NAME, ANY_QWEN), load, (_NAME,))
