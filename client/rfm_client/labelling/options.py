# SPDX-License-Identifier: MIT
"""What a caller says of a labelling run, checked once."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias, get_args

from rfm_client.contract.numbers import checked_count
from rfm_client.data.camera_fusion import FUSES, Fuse
from rfm_client.data.sampling import Rule

Mode: TypeAlias = Literal["prefix", "whole"]
Format: TypeAlias = Literal["progress", "signals", "hdf5"]

MODES: tuple[Mode, ...] = get_args(Mode)
FORMATS: tuple[Format, ...] = get_args(Format)
DEFAULT_WORKERS = 4

_NAME = re.compile(r"[A-Za-z0-9][\w-]{0,63}")
_RANGE = re.compile(r"(\d+)(?::(\d+))?")


@dataclass(frozen=True, kw_only=True)
class LabelOptions:
    """How a dataset is labelled. Raises ValueError.

    output: folder of the files; None: the dataset's own
    name: of the reward; the files are ``<name>_progress.parquet`` and ``reward_signals/<name>.parquet``
    alias: the progress file is written under this name, too: ``sarm_progress`` is what LeRobot's training reads
    formats: which files; empty: ``progress`` and ``signals``, of an HDF5 dataset ``hdf5``
    cameras: each is scored, and the scores fused; empty: all but depth cameras
    sampling, frames: the rule by which frame t's prefix is sampled, and to how many frames; None: as the checkpoint was
        trained (``Sampling.of``)
    mode: ``prefix``: frame t is scored on the frames up to t; ``whole``: all frames of an episode are scored together
    fuse: how the scores of several cameras become one
    resize: frames are made as small as the checkpoint reads them before they are sent
    episodes: some of the dataset's, by number; None: all
    limit: at most so many episodes
    shard: (i, n): part i, from 0, of n equal parts; then only parts are written, and a run without shard puts them
        together
    parts: folder or URL of the finished episodes; None: ``.<name>_parts`` in the output
    workers: episodes under way at a time
    overwrite: a file of another provenance is replaced
    verify: films are told from others by their SHA-256, not by their size and time of change
    in_place: with the format ``hdf5``: rewards are written into the dataset's own file
    """

    output: Path | None = None
    name: str = "rfm"
    alias: str | None = None
    formats: Sequence[Format] = ()
    cameras: Sequence[str] = ()
    sampling: Rule | None = None
    frames: int | None = None
    mode: Mode = "prefix"
    fuse: Fuse = "mean"
    resize: bool = False
    episodes: Sequence[int] | None = None
    limit: int | None = None
    shard: tuple[int, int] | None = None
    parts: str | None = None
    workers: int = DEFAULT_WORKERS
    overwrite: bool = False
    in_place: bool = False
    verify: bool = False

    def __post_init__(self) -> None:
        for where, name in (("name", self.name), ("alias", self.alias)):
            if name is not None and not _NAME.fullmatch(name):
                raise ValueError(f"{where}: expected 1 to 64 letters, digits, _ or -, got {name!r}")
        for each in self.formats:
            _check_one_of("formats", each, FORMATS)
        _check_one_of("mode", self.mode, MODES)
        _check_one_of("fuse", self.fuse, tuple(FUSES))
        if len(set(self.cameras)) != len(self.cameras):
            raise ValueError(f"cameras: expected each once, got {', '.join(self.cameras)}")
        if self.mode == "whole" and self.sampling not in (None, "all"):
            raise ValueError(f"sampling: expected all in mode whole, which shows every frame, got {self.sampling}")
        for where, numbers in (("episodes", self.episodes), ("shard", self.shard)):
            if numbers is not None:
                object.__setattr__(self, where, tuple(checked_count(where, each, least=0) for each in numbers))
        if self.shard is not None and self.shard[0] >= self.shard[1]:
            raise ValueError(f"shard: expected i/n with i from 0 to n - 1, got {self.shard[0]}/{self.shard[1]}")
        for where, number in (("workers", self.workers), ("limit", self.limit), ("frames", self.frames)):
            if number is not None:
                object.__setattr__(self, where, checked_count(where, number))


def parse_episodes(text: str) -> list[int]:
    """The numbers that ``0:100,205`` names: 0 to 99, and 205. Raises ValueError."""
    numbers: list[int] = []
    for part in text.split(","):
        match = _RANGE.fullmatch(part.strip())
        if match is None or (match[2] and int(match[2]) <= int(match[1])):
            raise ValueError(f"episodes: expected numbers and ranges such as 0:100,205, got {text!r}")
        numbers += range(int(match[1]), int(match[2])) if match[2] else [int(match[1])]
    return sorted(set(numbers))


def parse_shard(text: str) -> tuple[int, int]:
    """i and n of ``i/n``. Raises ValueError."""
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if match is None:
        raise ValueError(f"shard: expected i/n, for example 0/8, got {text!r}")
    return int(match[1]), int(match[2])


def _check_one_of(where: str, value: str, allowed: Sequence[str]) -> None:
    if value not in allowed:
        raise ValueError(f"{where}: expected one of {', '.join(allowed)}, got {value!r}")
