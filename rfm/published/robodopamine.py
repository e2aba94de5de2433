# SPDX-License-Identifier: MIT
"""Read Robo-Dopamine: an ordinary Qwen-VL, which only its name tells from others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rfm.families.robodopamine.checkpoint import RoboDopamineCheckpoint
from rfm.families.robodopamine.prompts import RoboDopamineConfig
from rfm.files import NETWORK_CONFIG, CheckpointError, is_there, read_json
from rfm.published.language import ANY_QWEN, LanguageFolder, is_named, reopened, stops_of
from rfm.published.provenance import Assumption
from rfm.published.reader import Loaded, Options, Reader
from rfm.published.run_config import find_run_config
from rfm.qwen.processor import pixel_limits, read_processor
from rfm.saved import is_saved, reward_model_of

_NAME = RoboDopamineConfig.reward_model
_OF_USER: dict[str, type] = {"mode": str, "interval": int}  # settings that ``--as`` takes


def reads(folder: Path) -> bool:
    """True if a folder holds an export of this model, or a Qwen-VL of its name without a run's config.yaml."""
    if reward_model_of(folder) is not None:
        return reward_model_of(folder) == _NAME
    content = read_json(folder / NETWORK_CONFIG) if is_there(folder / NETWORK_CONFIG) else {}
    return is_named(folder, _NAME) and content.get("model_type") in ANY_QWEN and find_run_config(folder) is None


def load(folder: Path, options: Options) -> Loaded:
    """Load the model of a local folder: a Qwen-VL's, or an export. Raises CheckpointError."""
    if options.video_prompt is not None:
        expected = "none: the prompt of this checkpoint has images"
        raise CheckpointError.at("--video-prompt", expected, options.video_prompt)
    given = options.settings(_OF_USER)
    assumptions: tuple[Assumption, ...] = ()
    if is_saved(folder):
        checkpoint = reopened(RoboDopamineCheckpoint, folder, options)
    else:
        files = LanguageFolder.read(folder, options, ANY_QWEN)
        _, preprocessor = read_processor(files.processor)
        limits = pixel_limits(preprocessor, f"base model {files.processor}")
        config = RoboDopamineConfig(**{**files.made_of, **limits}, stops=stops_of(folder))
        assumptions = files.assumptions(config)
        checkpoint = RoboDopamineCheckpoint(config, files.weights, files.processor)
    config = replace(checkpoint.config, **given)
    config.check()
    checkpoint = replace(checkpoint, config=config)
    checkpoint.check()
    return Loaded(checkpoint, assumptions)


READER = Reader(reads, load, (_NAME,))
