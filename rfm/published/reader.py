# SPDX-License-Identifier: MIT
"""How a reader of published checkpoints interprets the user's options, and the ``Loaded`` that it returns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfm.config import CheckpointConfig
from rfm.engine.family import Checkpoint, FrameEncoders
from rfm.files import CheckpointError
from rfm.published.provenance import Assumption

# Options, with the checkpoints that support them.
_FOLLOWED_BY = {
    "video_prompt": "a checkpoint that shows videos to a Qwen3-VL",
    "strict_answers": "a RoboReward that writes its answers",
    "weights": "a vision-language checkpoint whose weights are not rounded (other networks are small)",
    **dict.fromkeys(("robot_description", "camera_description"), "a RynnValue whose prompt names robot and camera"),
}


def check_used(options: CheckpointConfig, config: Any) -> None:
    """Raise CheckpointError for an option that the network does not support."""
    for name, expected in _FOLLOWED_BY.items():
        wanted = getattr(options, name)
        if wanted and getattr(config, name, None) != wanted:
            flag, mend = CheckpointConfig.settings()[name].option, "leave it out, or export the checkpoint again"
            raise CheckpointError.at(flag, expected, "another checkpoint", mend)


def asked(options: CheckpointConfig) -> tuple[str | None, dict[str, str]]:
    """Return the reward model's name and the user's settings for it, from ``name,setting=value,...``.

    Raises CheckpointError.
    """
    if options.reward_model is None:
        return None, {}
    name, *settings = options.reward_model.split(",")
    if wrong := [setting for setting in settings if setting.count("=") != 1]:
        raise CheckpointError.at("--as", "setting=value", repr(wrong[0]))
    return name, dict(setting.split("=") for setting in settings)


def settings_asked(options: CheckpointConfig, known: Mapping[str, type]) -> dict[str, Any]:
    """Return the user's reward model settings, converted to their types. Raises CheckpointError if one is wrong.

    known: types by setting
    """
    return {name: _value(name, text, known) for name, text in asked(options)[1].items()}


def _value(name: str, text: str, known: Mapping[str, type]) -> Any:
    if name not in known:
        expected = f"settings among {', '.join(known)}" if known else "no settings of this reward model"
        raise CheckpointError.at("--as", expected, repr(name))
    try:
        return {"true": True, "false": False}[text] if known[name] is bool else known[name](text)
    except (KeyError, ValueError):
        raise CheckpointError.at(f"--as: {name}", f"a value of type {known[name].__name__}", repr(text)) from None


@dataclass(frozen=True)
class Loaded:
    """A checkpoint as it was published, and what a user must know about it.

    assumptions: the settings that neither weights nor files prove
    notes: returns, for the checkpoint, one line for the user per contradiction to the known facts about training;
        raises CheckpointError
    encoders: returns the checkpoint's encoders, or None; raises CheckpointError if they are missing or do not fit
    """

    checkpoint: Checkpoint
    assumptions: Sequence[Assumption] = ()
    notes: Callable[[Any], Sequence[str]] = lambda _checkpoint: ()
    encoders: Callable[[], FrameEncoders | None] = lambda: None


@dataclass(frozen=True)
class Reader:
    """Reads a family's checkpoints as they were published, or as they were exported.

    reads: returns True if a folder may hold a checkpoint in this family; used if the caller names no family
    load: loads a checkpoint from a local folder; raises CheckpointError
    reward_models: names that ``--as`` takes, for ordinary models that the family prompts in its own way
    """

    reads: Callable[[Path], bool]
    load: Callable[[Path, CheckpointConfig], Loaded]
    reward_models: tuple[str, ...] = ()
