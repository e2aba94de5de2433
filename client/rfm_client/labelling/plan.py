# SPDX-License-Identifier: MIT
"""Which episodes are labelled, and what each one's label is made of, before the first frame is scored."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rfm_client.data.datasets.protocol import Dataset, DatasetError, Episode, digest_of
from rfm_client.labelling.options import LabelOptions
from rfm_client.labelling.recipe import Recipe


@dataclass(frozen=True)
class Item:
    """One episode to be labelled.

    digest: of everything that decides its labels
    num_bytes: of its frames as they are stored
    """

    episode: Episode
    digest: str
    num_bytes: int

    @property
    def key(self) -> str:
        """Name of its part."""
        return f"episode-{self.episode.index:06d}-{self.digest}"


@dataclass(frozen=True)
class Plan:
    """The episodes in the order of their frames, and how they are labelled.

    dataset: what provenance says of it
    """

    items: Sequence[Item]
    recipe: Recipe
    dataset: Mapping[str, Any]

    @property
    def num_frames(self) -> int:
        """Frames of all episodes."""
        return sum(item.episode.num_frames for item in self.items)

    def digests(self) -> dict[str, str]:
        """Of what each episode's labels are made, by its number."""
        return {str(item.episode.index): item.digest for item in self.items}

    def provenance(self) -> dict[str, Any]:
        """What the labels are made of. The same for the same labels, whoever made them, and when."""
        digest = digest_of(item.digest.encode() for item in self.items)
        version = importlib.metadata.version("rfm-client")
        dataset = {**self.dataset, "digest": digest}
        return {"writer": f"rfm-client {version}", "dataset": dataset, **self.recipe.document()}


def selected(dataset: Dataset, options: LabelOptions) -> list[Episode]:
    """The episodes that the options choose. Raises DatasetError for one that the dataset does not have."""
    episodes = {episode.index: episode for episode in dataset.episodes}
    wanted = sorted(episodes) if options.episodes is None else sorted(set(options.episodes))
    missing = [index for index in wanted if index not in episodes]
    if missing or not wanted:
        expected = f"some of the {len(episodes)} of the dataset"
        raise DatasetError.at("episodes", expected, ", ".join(map(str, missing[:5])) or "none")
    chosen = [episodes[index] for index in wanted[: options.limit]]
    if options.shard is not None:
        i, n = options.shard
        chosen = chosen[len(chosen) * i // n : len(chosen) * (i + 1) // n]
    return chosen


def make_plan(
    dataset: Dataset, recipe: Recipe, episodes: Sequence[Episode], checked: Callable[[Episode], None]
) -> Plan:
    """The plan. Finds every frame of every episode; raises DatasetError for the first that is not there.

    checked: called after each episode
    """
    document = json.dumps(recipe.document(), sort_keys=True).encode()
    items = []
    for episode in episodes:
        contents = {camera: dataset.check(episode, camera) for camera in recipe.cameras}
        films = [f"{camera} {content.digest}".encode() for camera, content in contents.items()]
        about = f"{episode.index} {episode.first_index} {episode.num_frames} {episode.task}".encode()
        num_bytes = sum(content.num_bytes for content in contents.values())
        items.append(Item(episode, digest_of([document, about, *films]), num_bytes))
        checked(episode)
    told = {"kind": dataset.kind, "source": dataset.source, "revision": dataset.revision}
    return Plan(items, recipe, told)
