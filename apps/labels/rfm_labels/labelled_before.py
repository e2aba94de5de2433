# SPDX-License-Identifier: MIT
"""Labels that exist when a run begins: kept if their recipe is the same, else replaced only on request."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from rfm_labels.blank_cameras import BlankCameras
from rfm_labels.cost import Cost
from rfm_labels.datasets.dataset import Dataset
from rfm_labels.datasets.faults import DatasetError, listed, require
from rfm_labels.episode_scores import SCORES, Columns
from rfm_labels.finished_episodes import Parts
from rfm_labels.plan import Item, Plan, make_plan
from rfm_labels.run import Watch

Reader: TypeAlias = Callable[[Sequence[Item]], Iterator[tuple[Item, Columns]]]

_OTHERS = "those of others, or of videos that have changed or were copied (--verify knows copies by their content)"


@dataclass(frozen=True)
class LabelFile:
    """An existing label file.

    flaw: why no run can keep its labels; None: its metadata tells how they were made
    digests: digest of each labelled item, by episode number
    read: yields the scores of items, as far as the file has them
    option: command-line option that chooses another name
    cost: of the last run that scored; None: unknown
    blank: cameras that show nothing
    """

    path: Path
    flaw: str | None
    provenance: Mapping[str, Any]
    digests: Mapping[int, str]
    read: Reader
    option: str
    cost: Cost | None = None
    blank: BlankCameras = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        path: Path,
        provenance: Any,
        digests: Any,
        read: Reader,
        option: str = "--name",
        cost: Cost | None = None,
        blank: BlankCameras | None = None,
    ) -> LabelFile:
        """Return the label file. provenance, digests: JSON texts of its metadata, None if absent"""
        told, by_episode = parsed_object(provenance), parsed_object(digests)
        if not str(told.get("writer")).startswith("rfm-client") or not isinstance(told.get("dataset"), dict):
            return cls(path, "labels of another program", {}, {}, read, option)
        known = {int(index): str(digest) for index, digest in by_episode.items() if index.isdecimal()}
        flaw = None if known else "no digests of its episodes"
        return cls(path, flaw, told, known, read, option, cost, blank or {})

    def check(self, plan: Plan, dataset: Dataset, known: Mapping[int, Item]) -> Mapping[int, Item]:
        """Return the file's items by episode number. Raises DatasetError if labels would be lost, or do not fit.

        known: items of the plan, and of label files checked before
        """
        there, now = _settings(_recipe(self.provenance)), _settings(_recipe(plan.provenance()))
        names = [name for name in dict.fromkeys([*now, *there]) if there.get(name) != now.get(name)]
        differ = "; ".join(f"{name}: {there.get(name, 'none')} there, {now.get(name, 'none')} now" for name in names)
        got = (self.provenance and differ) or self.flaw or ""
        require(self.path, self.flaw is None and not differ, "no labels, or those of the same recipe", got)

        lost = set(self.digests) - set(dataset.numbers)
        expected = f"labels of the dataset's {len(dataset.numbers)} episodes"
        require(self.path, not lost, expected, f"some of episode {min(lost, default=None)}")
        others = [dataset.episode(index) for index in sorted(self.digests) if index not in known]
        items = {item.episode.index: item for item in make_plan(dataset, plan.recipe, others).items}
        found = {index: {**known, **items}[index] for index in self.digests}
        changed = [index for index, digest in self.digests.items() if found[index].digest != digest]
        require(self.path, len(changed) < len(self.digests), "labels of this dataset's episodes", _OTHERS)
        chosen = {item.episode.index for item in plan.items}
        left = sorted(set(changed) - chosen)
        episodes = ", ".join(found[index].episode.name for index in left)
        expected = f"no change since the labels in {self.path}, or --episodes with {listed(left)}"
        require(episodes, not left, expected, "other frames or rows")
        return found


def joined(plan: Plan, dataset: Dataset, files: Sequence[LabelFile], overwrite: bool, watch: Watch) -> Plan:
    """Return the plan with all other episodes whose labels are in the files.

    Raises DatasetError, without ``overwrite``, for a file whose labels would be lost or do not fit the frames.
    """
    known: Mapping[int, Item] = {item.episode.index: item for item in plan.items}
    for file in files:
        try:
            known = {**known, **file.check(plan, dataset, known)}
        except DatasetError as error:
            if not overwrite:
                raise DatasetError(f"{error}: choose another {file.option}, or --overwrite") from error
            lost = f"; its labels of {len(file.digests)} episodes are replaced" if file.digests else ""
            watch.note(f"--overwrite: {error}{lost}")
    if len(known) > len(plan.items):
        watch.note(f"labels of {len(known) - len(plan.items)} other episodes are there, and are kept")
    return replace(plan, items=[known[index] for index in sorted(known)])


def earlier_cost(plan: Plan, files: Sequence[LabelFile]) -> Cost | None:
    """Return the first cost that a file with labels of this plan tells; None: no such file does."""
    digests = {item.digest for item in plan.items}  # labels of another recipe have other digests
    return next((file.cost for file in files if file.cost and digests & set(file.digests.values())), None)


def restore(plan: Plan, parts: Parts, files: Sequence[LabelFile]) -> None:
    """Write each missing part of the plan whose labels are in a file. Raises OSError."""
    cameras = ("", *(f".{camera}" for camera in plan.recipe.cameras))
    order = [name + camera for name in SCORES for camera in cameras]
    finished = parts.finished(plan.items)
    for file in files:
        missing = [item for item in plan.items if item.key not in finished]
        gone = [item for item in missing if file.digests.get(item.episode.index) == item.digest]
        for item, columns in file.read(gone) if gone else ():
            scores = {name: columns[name] for name in order if name in columns}
            of_all = [len(each) == item.episode.num_frames and np.isfinite(each).all() for each in scores.values()]
            if of_all and all(of_all):
                index = item.episode.index
                parts.write(item, scores, {name: of[index] for name, of in file.blank.items() if index in of})
                finished.add(item.key)


def _recipe(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """The provenance without the dataset's source: the episodes' digests identify the dataset."""
    dataset = provenance.get("dataset", {})
    return {**provenance, "writer": None, "dataset": {"kind": dataset.get("kind")}}


def _settings(document: Mapping[str, Any]) -> dict[str, str]:
    """Settings by their paths in messages, for example ``sampling.frames``."""
    settings: dict[str, str] = {}
    for name, value in document.items():
        if isinstance(value, Mapping):
            settings |= {f"{name}.{inner}": text for inner, text in _settings(value).items()}
        elif value is not None:
            settings[name] = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return settings


def parsed_object(document: Any) -> dict[str, Any]:
    """Return the object of a JSON text; empty if there is none."""
    try:
        parsed = json.loads(document)
    except (TypeError, ValueError):
        return {}
    return parsed if isinstance(parsed, dict) else {}
