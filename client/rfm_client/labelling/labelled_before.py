# SPDX-License-Identifier: MIT
"""Labels that are there when a run begins: kept if they are of the same recipe, and else replaced only on request."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from rfm_client.contract.samples import Float32Array
from rfm_client.data.datasets.protocol import Dataset, DatasetError
from rfm_client.labelling.episode_scores import PROGRESS, SUCCESS, Columns
from rfm_client.labelling.finished_episodes import Parts
from rfm_client.labelling.plan import Item, Plan, make_plan
from rfm_client.labelling.run import Watch

Reader: TypeAlias = Callable[[Sequence[Item]], Iterator[tuple[Item, Columns]]]

OF_ANOTHER_PROGRAM = "labels of another program"
_NO_RECIPE = {"writer"}  # of provenance: what does not decide the labels of an episode
_NO_RECIPE_OF_DATASET = {"digest", "revision", "source"}  # the digests of the episodes tell it from another one


@dataclass(frozen=True)
class LabelFile:
    """A file of labels that is there.

    flaw: why nothing of it can be kept, whatever the run; None: it says what its labels are made of
    digests: those of the items that its episodes were, by number
    read: gives the scores of items, as far as they are there
    option: chooses another name for it
    """

    path: Path
    flaw: str | None
    provenance: Mapping[str, Any]
    digests: Mapping[int, str]
    read: Reader
    option: str = "--name"

    @classmethod
    def of(cls, path: Path, provenance: Any, digests: Any, read: Reader, flaw: str = OF_ANOTHER_PROGRAM) -> LabelFile:
        """The file with these documents as it holds them, JSON. flaw: of a file that says no provenance of ours"""
        told, by_episode = _parsed(provenance), _parsed(digests)
        if not str(told.get("writer")).startswith("rfm-client") or not isinstance(told.get("dataset"), dict):
            return cls(path, flaw, {}, {}, read)
        flaw_of_ours = None if by_episode else "no digests of its episodes"
        return cls(path, flaw_of_ours, told, {int(index): digest for index, digest in by_episode.items()}, read)

    def check_recipe(self, plan: Plan) -> None:
        """Raises DatasetError unless its labels are of the plan's recipe; says which settings differ."""
        there, now = _settings(_recipe(self.provenance)), _settings(_recipe(plan.provenance()))
        names = [name for name in dict.fromkeys([*now, *there]) if there.get(name) != now.get(name)]
        differ = [f"{name}: {there.get(name, 'none')} there, {now.get(name, 'none')} now" for name in names]
        if self.flaw is not None or differ:
            got = "; ".join(differ) if self.provenance and differ else self.flaw or ""
            raise DatasetError.at(self.path, "no labels, or those of the same recipe", got)

    def check_episodes(self, items: Mapping[int, Item], chosen: Mapping[int, Item]) -> None:
        """Raises DatasetError unless its episodes are these items, or are chosen to be labelled again."""
        others = [index for index, digest in self.digests.items() if digest != items[index].digest]
        if len(others) == len(self.digests):
            raise DatasetError.at(self.path, "labels of this dataset's episodes", "those of others")
        for index in others:
            if index not in chosen:
                expected = f"the frames and rows of its labels in {self.path}, or --episodes with {index}"
                raise DatasetError.at(items[index].episode.name, expected, "others")


def joined(plan: Plan, dataset: Dataset, files: Sequence[LabelFile], overwrite: bool, watch: Watch) -> Plan:
    """The plan, and all episodes besides that the files have labels of.

    Raises DatasetError for a file whose labels would be lost, or would not be those of the frames any more. On
    ``overwrite`` such a file is replaced.
    """
    chosen = {item.episode.index: item for item in plan.items}
    known: Mapping[int, Item] = chosen
    for file in files:
        try:
            file.check_recipe(plan)
            more = {**known, **_items(plan, dataset, file, known, watch)}
            file.check_episodes(more, chosen)
        except DatasetError as error:
            if not overwrite:
                raise DatasetError(f"{error}: choose another {file.option}, or --overwrite") from error
            lost = f"; its labels of {len(file.digests)} episodes are replaced" if file.digests else ""
            watch.note(f"--overwrite: {error}{lost}")
        else:
            known = more
    if len(known) > len(chosen):
        watch.note(f"labels of {len(known) - len(chosen)} other episodes are there, and are kept")
    return replace(plan, items=[known[index] for index in sorted(known)])


def restore(plan: Plan, parts: Parts, files: Sequence[LabelFile]) -> None:
    """Writes the parts of the plan that are gone, and whose labels the files have. Raises OSError."""
    recipe = plan.recipe
    order = [name + camera for name in (PROGRESS, SUCCESS) for camera in ("", *(f".{each}" for each in recipe.cameras))]
    finished = parts.finished(plan.items)
    for file in files:
        gone = [
            item
            for item in plan.items
            if item.key not in finished and file.digests.get(item.episode.index) == item.digest
        ]
        for item, columns in file.read(gone) if gone else ():
            scores = {name: columns[name] for name in order if name in columns}
            if scores and all(_is_whole(each, item) for each in scores.values()):
                parts.write(item, scores)
                finished.add(item.key)


def _is_whole(scores: Float32Array, item: Item) -> bool:
    return len(scores) == item.episode.num_frames and bool(np.isfinite(scores).all())


def _items(plan: Plan, dataset: Dataset, file: LabelFile, known: Mapping[int, Item], watch: Watch) -> dict[int, Item]:
    """The items of the file's episodes that are not known. Raises DatasetError."""
    episodes = {episode.index: episode for episode in dataset.episodes}
    lost = sorted(set(file.digests) - set(episodes))
    if lost:
        raise DatasetError.at(
            file.path, f"labels of the dataset's {len(episodes)} episodes", f"some of episode {lost[0]}"
        )
    others = [episodes[index] for index in sorted(file.digests) if index not in known]
    watch.checking(len(others))
    return {item.episode.index: item for item in make_plan(dataset, plan.recipe, others, watch.checked).items}


def _recipe(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """What decides labels, whatever the episode."""
    document = {name: value for name, value in provenance.items() if name not in _NO_RECIPE}
    dataset = document.get("dataset", {})
    return {**document, "dataset": {key: dataset[key] for key in dataset if key not in _NO_RECIPE_OF_DATASET}}


def _settings(document: Mapping[str, Any]) -> dict[str, str]:
    """Each setting by its path, as messages show it: ``sampling.frames``."""
    settings: dict[str, str] = {}
    for name, value in document.items():
        if isinstance(value, Mapping):
            settings |= {f"{name}.{inner}": text for inner, text in _settings(value).items()}
        elif value is not None:
            settings[name] = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return settings


def _parsed(document: Any) -> dict[str, Any]:
    """The object of a JSON text; empty: there is none."""
    try:
        parsed = json.loads(document)
    except (TypeError, ValueError):
        return {}
    return parsed if isinstance(parsed, dict) else {}
