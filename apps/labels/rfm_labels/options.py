# SPDX-License-Identifier: MIT
"""Inputs for a labelling run: callbacks, and options validated once for both programs and command lines."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, TypeAlias, get_args

from rfm_client import RewardError
from rfm_client.frames import Fuse, Rule
from rfm_client.options import ConfigError, InvalidValueError, Settings, checked_count, setting
from rfm_labels.datasets.dataset import Dataset, DatasetEpisode
from rfm_labels.datasets.faults import listed, require

Mode: TypeAlias = Literal["prefix", "whole"]
ProgressRule: TypeAlias = Literal["remaining_over_first"]
Format: TypeAlias = Literal["progress", "signals"]
FORMATS: tuple[Format, ...] = get_args(Format)
DEFAULT_WORKERS = 4
LAST = "last"  # given instead of a goal picture
_NAME = re.compile(r"[A-Za-z0-9][\w-]{0,63}")
_RANGE = re.compile(r"(\d+)(?::(\d+))?")


class Watch:
    """Callbacks for a run. All do nothing by default; override what you need."""

    def note(self, text: str) -> None:
        """Receive a line for the user: a decision, or a warning."""

    def downloading(self, num_files: int, num_bytes: int) -> None:
        """Called before files of a Hub dataset are downloaded. An error prevents the download."""

    def checking(self, num_episodes: int) -> None:
        """Called before all episodes are checked."""

    def checked(self, episode: DatasetEpisode) -> None:
        """Called when all frames in an episode are found."""

    def begin(self, num_frames: int, num_finished: int) -> None:
        """Called before the first score, with the run's frame count and how many are already finished."""

    def scored(self, episode: DatasetEpisode) -> None:
        """Called when the episode is finished."""

    def failed(self, episode: DatasetEpisode, error: RewardError) -> None:
        """Called when the episode has failed."""


QUIET = Watch()


def parse_episodes(text: str) -> list[int]:
    """Parse episode numbers: ``0:100,205`` gives 0 to 99 and 205, sorted. Raises ValueError."""
    numbers: list[int] = []
    for part in text.split(","):
        match = _RANGE.fullmatch(part.strip())
        if match is None or (match[2] and int(match[2]) <= int(match[1])):
            raise InvalidValueError.at("episodes", "numbers and ranges such as 0:100,205", repr(text))
        numbers += range(int(match[1]), int(match[2])) if match[2] else [int(match[1])]
    return sorted(set(numbers))


def parse_shard(text: str) -> tuple[int, int]:
    """Parse ``i/n`` into i and n. Raises ValueError."""
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if match is None:
        raise InvalidValueError.at("shard", "i/n, for example 0/8", repr(text))
    return int(match[1]), int(match[2])


def check_name(setting: str, name: str | None) -> None:
    """Raise ConfigError unless a reward or alias may have this name."""
    if name is not None and not _NAME.fullmatch(name):
        raise ConfigError.at(setting, "1 to 64 letters, digits, _ or -", repr(name))


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split(",")) if text else ()


@dataclass(frozen=True, kw_only=True)
class LabelOptions(Settings):
    """Options for a labelling run. Raises ConfigError, a ValueError.

    cameras: empty: all but depth cameras
    sampling, frames: None: as in the checkpoint's training (``Sampling.of``)
    episodes: numbers; None: all
    filter_key: label only its episodes; None: all
    shard: (i, n): label share i out of n equal shares, counted from 0, without label files; a later run without shard
        writes them
    parts: None: ``.<name>_parts`` in the output folder
    """

    TITLE: ClassVar[str] = "Labels"

    output: Path | None = setting(None, "Folder of the labels; else the dataset's own.")
    name: str = setting("rfm", "Name of the reward: NAME_progress.parquet and reward_signals/NAME.parquet.")
    alias: str | None = setting(
        None, "Write the progress file under this name, too: sarm_progress is what LeRobot reads."
    )
    formats: Sequence[Format] = setting(
        FORMATS,
        "Output formats.",
        flag="--format",
        metavar=",".join(FORMATS),
        parse=_names,
    )
    cameras: Sequence[str] = setting(
        (), "Cameras to score. Default: all except depth cameras.", metavar="KEY[,KEY...]", parse=_names
    )
    views: Sequence[str] = setting(
        (),
        "Further cameras to show beside a single one of --cameras, for Robo-Dopamine: the left wrist, then the right.",
        metavar="KEY,KEY",
        parse=_names,
    )
    goal: str | None = setting(
        None,
        f"Picture of the task done, for Robo-Dopamine; {LAST}: the last frame of each episode.",
        metavar=f"IMAGE|{LAST}",
    )
    fuse: Fuse = setting("mean", "How to combine the scores of several cameras.")
    sampling: Rule | None = setting(None, "Sampling rule of each prefix. Default: as in training.")
    frames: int | None = setting(None, "Frames per prefix. Default: as in training.", least=1)
    progress_rule: ProgressRule | None = setting(
        None,
        "How progress is made of remaining seconds, for a model without progress: "
        "remaining_over_first: 1 - the seconds / those of the episode's first frame.",
    )
    advantage: int | None = setting(
        None,
        "Also write each frame's advantage over N frames, by RECAP's rule: the progress gained, less N / the steps of "
        "the task's longest episode.",
        least=1,
    )
    mode: Mode = setting("prefix", "prefix: frame t is scored on the frames up to t. whole: all frames together.")
    resize: bool = setting(False, "Downscale frames to the model's input size before sending.")
    episodes: Sequence[int] | None = setting(
        None, "Numbers of the episodes to label.", metavar="0:100,205", parse=parse_episodes
    )
    filter_key: str | None = setting(
        None,
        "Only the episodes of an RLDS split, or of a filter key of robomimic's HDF5 files, such as train or valid.",
        metavar="KEY",
    )
    limit: int | None = setting(None, "Label at most N episodes.", least=1)
    shard: tuple[int, int] | None = setting(
        None,
        "Label only part I of N, counted from 0. Run without it to write the files.",
        metavar="I/N",
        parse=parse_shard,
    )
    parts: str | None = setting(
        None, "Folder for finished episodes. Default: .NAME_parts in the output.", metavar="FOLDER|URL"
    )
    workers: int = setting(DEFAULT_WORKERS, "Episodes to score at a time.", least=1)
    overwrite: bool = setting(
        False, "Replace label files even if this run does not reproduce all their labels by the same recipe."
    )

    def __post_init__(self) -> None:
        for name in ("episodes", "shard"):
            if getattr(self, name) is not None:
                numbers = tuple(checked_count(name, each, least=0) for each in getattr(self, name))
                object.__setattr__(self, name, numbers)
        super().__post_init__()
        for name in ("name", "alias"):
            check_name(name, getattr(self, name))
        if not self.formats or set(self.formats) - set(FORMATS):
            raise ConfigError.at("formats", f"some of {', '.join(FORMATS)}", ", ".join(self.formats) or "none")
        if len(set(self.cameras)) != len(self.cameras):
            raise ConfigError.at("cameras", "each once", ", ".join(self.cameras))
        if self.mode == "whole" and self.sampling not in (None, "all"):
            raise ConfigError.at("sampling", "all in mode whole, which shows every frame", self.sampling)
        if self.shard is not None and self.shard[0] >= self.shard[1]:
            raise ConfigError.at("shard", "i/n with i from 0 to n - 1", f"{self.shard[0]}/{self.shard[1]}")


DEFAULTS = LabelOptions()


@dataclass(frozen=True)
class RayOptions(Settings):
    """Ray cluster, actor count and GPUs per actor. Raises ConfigError, a ValueError."""

    TITLE: ClassVar[str] = "With --engine ray"

    address: str | None = setting(
        None, "Address of a Ray cluster. Default: a running one, or a new one on this machine."
    )
    actors: int = setting(1, "Number of Ray actors.", least=1)
    num_gpus_per_actor: float = setting(0.0, "GPUs per Ray actor.", least=0)


def chosen_numbers(dataset: Dataset, options: LabelOptions) -> list[int]:
    """Return the episode numbers that the options choose. Raises DatasetError for an unknown episode."""
    known = set(dataset.numbers)
    wanted = sorted(known) if options.episodes is None else sorted(set(options.episodes))
    missing = [number for number in wanted if number not in known]
    got = f"{listed(missing) or 'none'}; it has {listed(sorted(known))}"
    require("episodes", bool(wanted) and not missing, f"some of the dataset's {len(known)} episodes", got)
    if options.filter_key is not None:
        keys = ", ".join(dataset.filter_keys)
        is_known = options.filter_key in dataset.filter_keys
        expected = f"one of {keys}" if keys else "none, since the dataset has no filter keys"
        require("filter_key", is_known, expected, repr(options.filter_key))
        of_key = dataset.filter_keys[options.filter_key]
        gone = [number for number in of_key if number not in known]
        got = f"{', '.join(map(str, gone[:5])) or 'none'} in {options.filter_key}"
        wanted = sorted(set(wanted) & set(of_key))
        require("filter_key", bool(wanted) and not gone, f"some of the {len(known)} episodes of the dataset", got)
    chosen = wanted[: options.limit]
    if options.shard is not None:
        i, n = options.shard
        chosen = chosen[len(chosen) * i // n : len(chosen) * (i + 1) // n]
    return chosen
