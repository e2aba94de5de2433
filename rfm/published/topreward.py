# SPDX-License-Identifier: MIT
"""Read TOPReward: settings from LeRobot, or from the user, and an ordinary Qwen3-VL."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rfm.config import CheckpointConfig
from rfm.families.topreward.checkpoint import TopRewardCheckpoint
from rfm.families.topreward.prompts import PROMPT_PREFIX, PROMPT_SUFFIX, TopRewardConfig
from rfm.files import NETWORK_CONFIG, CheckpointError, network_config, read_json, shown
from rfm.published.hub import find
from rfm.published.language import LanguageFolder, reopened
from rfm.published.reader import Loaded, Reader, asked, settings_asked
from rfm.published.run_config import check_lerobot
from rfm.qwen.processor import (
    SIZED_BY_PROCESSOR,
    VIDEO_PREPROCESSOR,
    VIDEO_PREPROCESSOR_CONFIG,
    check_settings,
    read_preprocessor,
)
from rfm.saved import is_saved, reward_model_of
from rfm_client.contract.checks import require

LEROBOT, ROBOMETER = "topreward", "topreward-robometer"  # values for ``--as``
REWARD_MODELS = (LEROBOT, ROBOMETER)
_TYPE = "topreward"  # value of the key ``type`` in LeRobot's config.json
FPS = 2.0  # LeRobot's default
MAX_FRAMES, NUM_PREFIXES = 64, 15  # in Robometer's baseline
MOST_FRAMES = 512  # default limit in LeRobot's variant: each prefix costs a question
# Keys in LeRobot's config.json without effect here: loading the base model, cropping online samples.
_IDLE = {"attn_implementation", "max_frames", "max_input_length", "torch_dtype", "vlm_name"}
_DECIDING = {
    "add_chat_template": "chat_template",
    "fps": "fps",
    "prompt_prefix": "prompt_prefix",
    "prompt_suffix_template": "prompt_suffix",
}
# Settings that ``--as`` takes.
_USER_SETTINGS = {"num_prefixes": int, "fps": float, "chat_template": bool, "max_frames": int}


def reads(folder: Path) -> bool:
    """True if the folder holds LeRobot's TOPReward settings, or an export of TOPReward."""
    return network_config(folder).get("type") == _TYPE or reward_model_of(folder) == TopRewardConfig.reward_model


def load(folder: Path, options: CheckpointConfig) -> Loaded:
    """Load the model from a local folder: a Qwen3-VL's, LeRobot's settings, or an export. Raises CheckpointError."""
    name, given = asked(options)
    if is_saved(folder):
        checkpoint = reopened(TopRewardCheckpoint, folder, options)
        if given or name not in (None, LEROBOT if checkpoint.config.variant == "lerobot" else ROBOMETER):
            raise CheckpointError("--as: expected none for an export, which has its own; export the checkpoint again")
        checkpoint.check()
        return Loaded(checkpoint)
    content = read_json(folder / NETWORK_CONFIG)
    of_lerobot: dict[str, Any] = {}
    if content.get("type") == _TYPE:
        if name == ROBOMETER:
            raise CheckpointError.at("--as", f"{LEROBOT} for a config.json of LeRobot", name)
        of_lerobot = _lerobot_settings(content, folder / NETWORK_CONFIG)
        named = find(options.base_model or str(content.get("vlm_name")))
        files = LanguageFolder.read(named, replace(options, base_model=None))
    else:
        files = LanguageFolder.read(folder, options)
    config = TopRewardConfig(**files.made_of, **_settings(files, of_lerobot, options))
    checkpoint = TopRewardCheckpoint(config, files.weights, files.processor)
    checkpoint.check()
    return Loaded(checkpoint, files.assumed)


def _settings(files: LanguageFolder, of_lerobot: Mapping[str, Any], options: CheckpointConfig) -> dict[str, Any]:
    """Return the fields of TopRewardConfig that no Qwen3-VL file holds. Raises CheckpointError."""
    name, given = asked(options)
    is_lerobot = name != ROBOMETER
    settings: dict[str, Any] = {
        "variant": "lerobot" if is_lerobot else "robometer",
        "chat_template": not is_lerobot,
        "fps": FPS,
        "num_prefixes": None if is_lerobot else NUM_PREFIXES,
        "max_frames": MOST_FRAMES if is_lerobot else MAX_FRAMES,
        "prompt_prefix": PROMPT_PREFIX,
        "prompt_suffix": PROMPT_SUFFIX,
        **_limits(files, is_lerobot=is_lerobot),
        **of_lerobot,
        **settings_asked(options, _USER_SETTINGS),
    }
    if not is_lerobot and "fps" in given:
        raise CheckpointError(f"--as: fps: expected none for {ROBOMETER}, which takes each video for 24 frames/s")
    _check(settings)
    return settings


def _lerobot_settings(content: Mapping[str, Any], file: Path) -> dict[str, Any]:
    """Return the fields of TopRewardConfig in LeRobot's config.json. Raises CheckpointError as ``check_lerobot``."""
    check_lerobot(content, file, _DECIDING, _IDLE)
    return {field: content[key] for key, field in _DECIDING.items()}


def _limits(files: LanguageFolder, *, is_lerobot: bool) -> dict[str, int]:
    """Return a video's least and most pixels according to its processor. Raises CheckpointError."""
    sampling = {} if is_lerobot else {"do_sample_frames": True}  # LeRobot says which frames are shown
    try:
        preprocessor = read_preprocessor(files.processor, *VIDEO_PREPROCESSOR)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"base model {files.processor}: {error} (name its folder with --base-model)") from error
    size = preprocessor.get("size")
    where = f"{files.processor}: {VIDEO_PREPROCESSOR_CONFIG}"
    if not isinstance(size, dict) or not all(type(size.get(edge)) is int for edge in ("shortest_edge", "longest_edge")):
        raise CheckpointError.at(f"{where}: size", "shortest_edge and longest_edge", shown(size))
    check_settings(preprocessor, {**SIZED_BY_PROCESSOR, **sampling}, where)
    return {"least_px": size["shortest_edge"], "most_px": size["longest_edge"]}


def _check(settings: Mapping[str, Any]) -> None:
    """Raise CheckpointError for settings from which no prompt can be made."""
    prefixes, fps, suffix = settings["num_prefixes"], settings["fps"], settings["prompt_suffix"]
    if prefixes is not None and prefixes < 2:
        raise CheckpointError.at("num_prefixes", "at least 2, the first and the last", prefixes)
    require("max_frames", settings["max_frames"] >= 1, "at least 1", settings["max_frames"], CheckpointError)
    require("fps", 0 < float(fps) < float("inf"), "a finite number above 0", shown(fps), CheckpointError)
    try:
        is_good = suffix.format(instruction="TASK") != suffix.format(instruction="")
    except (AttributeError, IndexError, LookupError, ValueError):
        is_good = False
    require("prompt_suffix", is_good, "text with {instruction}", shown(suffix), CheckpointError)


READER = Reader(reads, load, REWARD_MODELS)
