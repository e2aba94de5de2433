# SPDX-License-Identifier: MIT
"""The plan of a labelling run, made before the first frame is scored: its episodes and its recipe."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from rfm_client import InvalidSampleError
from rfm_client.frames import ChannelOrder, Correction, Fuse, Orientation, Sampling
from rfm_labels.datasets.dataset import Dataset, DatasetEpisode
from rfm_labels.datasets.faults import listed, require
from rfm_labels.datasets.stored_files import digest_of
from rfm_labels.options import LabelOptions, Mode
from rfm_labels.scorer import CheckpointFacts

_RECIPE_FORMAT = 4  # increased when the same recipe gives other scores or other digests
_OF_TRAINING = {True: "as upstream's training pads shorter clips", False: "the checkpoint's training did not pad"}
_OF_CHECKPOINT = "the most in training; if the checkpoint does not say, the most its network takes"


@dataclass(frozen=True)
class Recipe:
    """All settings that decide a label, besides the frames.

    decoders: library that decodes each camera's frames, with version, since versions differ in colours; None: pixels
    corrections: of the cameras whose frames are turned, or stored as BGR
    verify: True: videos are identified by their content
    """

    checkpoint: CheckpointFacts
    cameras: tuple[str, ...]
    decoders: Mapping[str, str | None]
    corrections: Mapping[str, Correction]
    sampling: Sampling
    mode: Mode
    fuse: Fuse
    resize: bool
    verify: bool

    @classmethod
    def of(cls, options: LabelOptions, dataset: Dataset, checkpoint: CheckpointFacts) -> Recipe:
        """Return the recipe of the options; the dataset and the checkpoint decide the rest.

        Raises DatasetError for an unknown camera, InvalidSampleError if the rule lacks its number of frames, or for
        another mode than ``whole`` with a checkpoint that needs the whole episode.
        """
        numbers = chosen_numbers(dataset, replace(options, shard=None))
        cameras = dataset.chosen_cameras(options.cameras, numbers)
        require(dataset.source, bool(cameras), "at least one camera", "none")
        if checkpoint.needs_whole_episode and options.mode != "whole":
            why = "of this model, whose scores are relative to the whole episode"
            raise InvalidSampleError.at("mode", f"whole {why}", f"{options.mode}; give --mode whole")
        rule = "all" if options.mode == "whole" else options.sampling
        padding = checkpoint.trained_padding
        try:
            sampling = Sampling.of(rule, options.frames, checkpoint.max_frames, trained_padding=padding)
        except ValueError as error:
            raise InvalidSampleError(f"{error}: name them (--frames), or show all (--sampling all)") from error
        return cls(
            checkpoint,
            cameras,
            decoders={camera: dataset.decoder(camera) for camera in cameras},
            corrections={camera: each for camera, each in dataset.corrections.items() if camera in cameras},
            sampling=sampling,
            mode=options.mode,
            fuse=options.fuse,
            resize=options.resize,
            verify=options.verify,
        )

    @property
    def orientations(self) -> Mapping[str, Orientation]:
        """Orientation of each camera that is turned."""
        return {camera: each.orient for camera, each in self.corrections.items() if each.orient != "none"}

    @property
    def channels(self) -> Mapping[str, ChannelOrder]:
        """Order of the stored colours of each camera that does not store RGB."""
        return {camera: each.channels for camera, each in self.corrections.items() if each.channels != "rgb"}

    def in_one_pass(self, num_frames: int) -> bool:
        """True if one pass over ``num_frames`` frames gives every frame's score."""
        rule, frames = self.sampling.rule, self.sampling.frames
        shows_all = rule == "all" or (rule == "rint" and frames is not None and num_frames <= frames)
        return self.mode == "whole" or (shows_all and self.checkpoint.is_causal)

    def document(self) -> dict[str, Any]:
        """Return the recipe as it stands in the provenance."""
        return {
            "format": _RECIPE_FORMAT,
            "checkpoint": self.checkpoint.document(),
            "cameras": list(self.cameras),
            "decoders": dict(self.decoders),
            "orientations": dict(self.orientations),
            **({"channels": dict(self.channels)} if self.channels else {}),  # as labels made before have no such field
            "sampling": asdict(self.sampling),
            "mode": self.mode,
            "fuse": self.fuse if len(self.cameras) > 1 else None,
            "resize": str(self.checkpoint.frame_size) if self.resize else None,
            "verify": self.verify,
        }

    def told(self, options: LabelOptions) -> list[str]:
        """Return a line for each decision, with its reason."""
        lines = [f"cameras: {', '.join(self.cameras)} ({'asked for' if options.cameras else 'all but depth cameras'})"]
        if self.mode == "whole":
            lines.append("mode: whole: the score of frame t may depend on later frames, unless the network is causal")
        else:
            who = "asked for" if options.sampling else _OF_TRAINING[self.checkpoint.trained_padding]
            lines.append(f"sampling: {self.sampling.rule} ({who})")
        if self.sampling.frames is not None:
            lines.append(f"frames: {self.sampling.frames} ({'asked for' if options.frames else _OF_CHECKPOINT})")
        return lines + [f"fuse: {self.fuse} of {len(self.cameras)} cameras"] * (len(self.cameras) > 1)

    def check_lengths(self, episodes: Sequence[DatasetEpisode]) -> None:
        """Raise DatasetError for an episode above the checkpoint's limit, if the recipe shows whole episodes."""
        limit = self.checkpoint.max_frames
        shows_all = self.mode == "whole" or self.sampling.frames is None
        if not (episodes and shows_all and limit is not None):
            return
        lengths = {episode: max(count for _, count in episode.stretches) for episode in episodes}
        longest = max(episodes, key=lambda episode: lengths[episode])
        remedy = "use mode prefix and a rule with a number of frames"
        if self.checkpoint.needs_whole_episode:
            remedy = "name a checkpoint that takes more (--as topreward,max_frames=N)"
        fit = [episode.index for episode in episodes if lengths[episode] <= limit]
        rest = f"; to label the {len(fit)} that are short enough: --episodes {listed(fit)}" if fit else ""
        got = f"{lengths[longest]}: {remedy}{rest}"
        require(longest.name, len(fit) == len(episodes), f"at most {limit} frames, as the checkpoint takes", got)


@dataclass(frozen=True)
class Item:
    """One episode to label. digest: of everything that decides its labels"""

    episode: DatasetEpisode
    digest: str

    @property
    def key(self) -> str:
        """Name of the item's part."""
        return f"episode-{self.episode.index:06d}-{self.digest}"


@dataclass(frozen=True)
class Plan:
    """The episodes to label, in the order of their frames, and the recipe.

    dataset: its kind, source and revision, for the provenance
    """

    items: Sequence[Item]
    recipe: Recipe
    dataset: Mapping[str, Any]

    @property
    def num_frames(self) -> int:
        """Number of frames of all episodes."""
        return sum(item.episode.num_frames for item in self.items)

    def digests(self) -> dict[str, str]:
        """Return each item's digest by episode number."""
        return {str(item.episode.index): item.digest for item in self.items}

    def provenance(self) -> dict[str, Any]:
        """Return writer, dataset and recipe of the labels, without user and time: equal runs give equal provenance."""
        digest = digest_of(item.digest.encode() for item in self.items)
        version = importlib.metadata.version("rfm-client")
        dataset = {**self.dataset, "digest": digest}
        return {"writer": f"rfm-client {version}", "dataset": dataset, **self.recipe.document()}


def selected(dataset: Dataset, options: LabelOptions) -> list[DatasetEpisode]:
    """Return the episodes that the options choose; the others are not read.

    Raises DatasetError for an episode that the dataset lacks, or that cannot be read.
    """
    episodes = dataset.read(chosen_numbers(dataset, options))
    if options.shard is None:  # the episodes of another shard may need the task
        dataset.given_task.check_used(episodes)
    return episodes


def chosen_numbers(dataset: Dataset, options: LabelOptions) -> list[int]:
    """Return the numbers of the episodes that the options choose. Raises DatasetError for an unknown episode."""
    known = set(dataset.numbers)
    wanted = sorted(known) if options.episodes is None else sorted(set(options.episodes))
    missing = [number for number in wanted if number not in known]
    got = f"{', '.join(map(str, missing[:5])) or 'none'}; it has {listed(sorted(known))}"
    require("episodes", bool(wanted) and not missing, f"some of the {len(known)} of the dataset", got)
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


def make_plan(dataset: Dataset, recipe: Recipe, episodes: Iterable[DatasetEpisode]) -> Plan:
    """Return the plan of these episodes, without a look at a video's frames. Raises DatasetError for a missing file."""
    document = json.dumps(recipe.document(), sort_keys=True)
    items = []
    for episode in episodes:
        about = f"{episode.index} {episode.first_index} {episode.num_frames} {episode.task}"
        about += f" {episode.tasks}" if episode.tasks else ""
        videos = [f"{each} {dataset.identity(episode, each, verify=recipe.verify)}" for each in recipe.cameras]
        items.append(Item(episode, digest_of(part.encode() for part in (document, about, *videos))))
    return Plan(items, recipe, {"kind": dataset.kind, "source": dataset.source, "revision": dataset.revision})
