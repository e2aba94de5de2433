# SPDX-License-Identifier: MIT
"""Read RoboReward: an ordinary Qwen3-VL that only its name identifies."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from rfm.config import CheckpointConfig
from rfm.families.roboreward.checkpoint import RoboRewardCheckpoint
from rfm.families.roboreward.prompts import RoboRewardConfig
from rfm.files import CheckpointError
from rfm.published.language import ONLY_QWEN3, LanguageFolder, is_ours, reopened, stops_of
from rfm.published.provenance import Assumption
from rfm.published.reader import Loaded, Reader, asked, settings_asked
from rfm.saved import is_saved

WRITTEN, EXPECTED = "roboreward", "roboreward-expected"  # values for ``--as``
REWARD_MODELS = (WRITTEN, EXPECTED)


def load(folder: Path, options: CheckpointConfig) -> Loaded:
    """Load the model from a local folder: a Qwen3-VL's, or an export. Raises CheckpointError."""
    name, _ = asked(options)
    settings_asked(options, {})
    assumptions: tuple[Assumption, ...] = ()
    if is_saved(folder):
        checkpoint = reopened(RoboRewardCheckpoint, folder, options)
        if name is not None and checkpoint.config.is_expected != (name == EXPECTED):
            remedy = "export the checkpoint again"
            raise CheckpointError.at("--as", "the reward model of this export", name, remedy)
    else:
        files = LanguageFolder.read(folder, options)
        made_of = {**files.made_of, "dtype": "bfloat16"}  # as the original loads it, whatever config.json says
        config = RoboRewardConfig(**made_of, stops=stops_of(folder), is_expected=name == EXPECTED)
        assumptions = files.assumed_but("dtype")
        checkpoint = RoboRewardCheckpoint(config, files.weights, files.processor)
    if options.strict_answers and not checkpoint.config.is_expected:
        checkpoint = replace(checkpoint, config=replace(checkpoint.config, strict_answers=True))
    checkpoint.check()
    return Loaded(checkpoint, assumptions)


READER = Reader(partial(is_ours, RoboRewardConfig.reward_model, ONLY_QWEN3), load, REWARD_MODELS)
