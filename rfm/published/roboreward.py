# SPDX-License-Identifier: MIT
"""Read RoboReward: an ordinary Qwen3-VL, which only its name tells from others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rfm.families.roboreward.checkpoint import RoboRewardCheckpoint
from rfm.families.roboreward.prompts import RoboRewardConfig
from rfm.files import NETWORK_CONFIG, CheckpointError, is_there, read_json
from rfm.published.language import LanguageFolder, is_named, reopened, stops_of
from rfm.published.provenance import Assumption
from rfm.published.reader import Loaded, Options, Reader
from rfm.published.run_config import find_run_config
from rfm.qwen.network import QWEN3
from rfm.saved import is_saved, reward_model_of

WRITTEN, EXPECTED = "roboreward", "roboreward-expected"  # of ``--as``
REWARD_MODELS = (WRITTEN, EXPECTED)


def reads(folder: Path) -> bool:
    """True if the folder holds an export of RoboReward, or a Qwen3-VL of its name without a run's config.yaml."""
    if reward_model_of(folder) is not None:
        return reward_model_of(folder) == RoboRewardConfig.reward_model
    content = read_json(folder / NETWORK_CONFIG) if is_there(folder / NETWORK_CONFIG) else {}
    has_name = is_named(folder, "roboreward")
    return has_name and content.get("model_type") == QWEN3 and find_run_config(folder) is None


def load(folder: Path, options: Options) -> Loaded:
    """Load the model of a local folder: a Qwen3-VL's, or an export. Raises CheckpointError."""
    name, _ = options.named()
    options.settings({})
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
        assumptions = tuple(each for each in files.assumptions(config) if each.name != "dtype")
        checkpoint = RoboRewardCheckpoint(config, files.weights, files.processor)
    if options.strict_answers and not checkpoint.config.is_expected:
        checkpoint = replace(checkpoint, config=replace(checkpoint.config, strict_answers=True))
    checkpoint.check()
    return Loaded(checkpoint, assumptions)


READER = Reader(reads, load, REWARD_MODELS)
