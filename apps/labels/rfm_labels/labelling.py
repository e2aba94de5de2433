# SPDX-License-Identifier: MIT
"""Label a dataset: plan, score, write the label files.

Labels of the same recipe that are there stay. Others are replaced on request alone.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rfm_labels.datasets.dataset import SIGNALS_FOLDER, Dataset
from rfm_labels.datasets.faults import DatasetError
from rfm_labels.label_files import LabelFile, parquet_labels
from rfm_labels.metadata import SCORES, Cost, blank_from_metadata, blank_lines, skipping_in
from rfm_labels.options import DEFAULTS, QUIET, LabelOptions, Watch
from rfm_labels.plan import Item, Plan, all_faults, plan_labels
from rfm_labels.scorer import Scorer
from rfm_labels.scoring import FailedEpisode, Run
from rfm_labels.summary import Summary, summary_of
from rfm_labels.writing import (
    IDENTITY,
    PROGRESS_ENDING,
    Parts,
    progress_file,
    signals_file,
    with_totals,
    write_sidecars,
)


@dataclass(frozen=True)
class Report:
    """The result of a labelling run.

    files: label files that were written; empty if an episode failed, or for a shard
    failures: episodes without labels
    parts: folder or URL of the finished episodes
    summary: None: no file was written
    plan: the episodes to label, and the recipe
    """

    files: Sequence[Path]
    failures: Sequence[FailedEpisode]
    parts: str
    summary: Summary | None
    plan: Plan


def label(dataset: Dataset, scorer: Scorer, options: LabelOptions = DEFAULTS, watch: Watch = QUIET) -> Report:
    """Label every frame of the chosen episodes, and write the label files.

    If an episode fails, the report names it, and no label file is written. The same call then labels only the missing
    episodes.

    Raises DatasetError, before the first score, for a contradictory dataset or a label file that this run may not
    replace; RewardError if the scorer is gone; OSError for a full disk.
    """
    outputs, plan, earlier = prepared(dataset, scorer, options, watch)
    run = Run(plan, dataset, scorer, outputs.parts, watch)
    failures = run.finish_all(options.workers)
    return put_together(plan, dataset, outputs, failures, run.cost or earlier, watch)


def prepared(
    dataset: Dataset, scorer: Scorer, options: LabelOptions, watch: Watch
) -> tuple[Outputs, Plan, Cost | None]:
    """Make and check the plan, and restore parts from label files. Return the cost of the labels that exist, too."""
    outputs = Outputs.of(dataset, options)
    if options.shard is None:
        outputs.make_folder()
    checked = check(plan_labels(dataset, scorer, options, watch), dataset, outputs, watch)
    restore(checked.plan, outputs.parts, checked.before)
    return outputs, checked.plan, earlier_cost(checked.plan, checked.before)


@dataclass(frozen=True)
class CheckedPlan:
    """A plan after all frames were found.

    plan: chosen episodes, and others with kept labels
    before: existing label files
    num_bytes: stored size by episode number
    """

    plan: Plan
    before: Sequence[LabelFile]
    num_bytes: Mapping[int, int]


def check(plan: Plan, dataset: Dataset, outputs: Outputs, watch: Watch = QUIET) -> CheckedPlan:
    """Check everything that a run needs before the first score, also for labelled episodes. Write nothing.

    Rows and checks may have changed since the labels were made. Raises DatasetError.
    """
    options = outputs.options
    before = outputs.before() if options.shard is None else []
    plan = joined(plan, dataset, before, options.overwrite, watch)
    watch.checking(len(plan.items))
    num_bytes = {}
    with all_faults(dataset, options):
        for item in plan.items:
            num_bytes[item.episode.index] = sum(
                dataset.check(item.episode, camera) for camera in plan.recipe.decoded_cameras
            )
            watch.checked(item.episode)
    for line in dataset.frame_notes:
        watch.note(line)
    return CheckedPlan(plan, before, num_bytes)


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
                told = f"{error.problem}: choose another {file.option}, or --overwrite"
                raise DatasetError(told, error.where) from error
            lost = f"; its labels of {len(file.digests)} episodes are replaced" if file.digests else ""
            watch.note(f"--overwrite: {error}{lost}")
    if len(known) > len(plan.items):
        watch.note(f"labels of {len(known) - len(plan.items)} other episodes are there, and are kept")
    return replace(plan, items=[known[index] for index in sorted(known)])


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
            skipping = skipping_in(scores)
            answered = slice(None) if skipping is None else np.isfinite(scores[skipping])
            of_all = [
                len(each) == item.episode.num_frames and np.isfinite(each[answered]).all() for each in scores.values()
            ]
            if of_all and all(of_all):
                index = item.episode.index
                parts.write(item, scores, {name: of[index] for name, of in file.blank.items() if index in of})
                finished.add(item.key)


def earlier_cost(plan: Plan, files: Sequence[LabelFile]) -> Cost | None:
    """Return the first cost that a file with labels of this plan tells; None: no such file does."""
    digests = {item.digest for item in plan.items}  # labels of another recipe have other digests
    return next((file.cost for file in files if file.cost and digests & set(file.digests.values())), None)


def put_together(
    plan: Plan,
    dataset: Dataset,
    outputs: Outputs,
    failures: Sequence[FailedEpisode],
    cost: Cost | None,
    watch: Watch,
) -> Report:
    """Write the label files, unless an episode failed or the run labelled only a shard."""
    report = Report([], failures, outputs.parts.url, None, plan)
    if failures or outputs.options.shard is not None:
        return report
    labels = outputs.parts.read_all(plan)
    blank = blank_from_metadata(labels.schema.metadata)
    for line in blank_lines(blank, len(plan.items)):
        watch.note(line)
    files = outputs.write(plan, labels, cost)
    for name, score in SCORES.items():
        if name in labels.column_names and (told := score.told(labels[name].to_numpy())):
            watch.note(f"{told}; the column {name} marks them")
    num_episodes = len(dataset.numbers)
    if len(plan.items) < num_episodes:
        others = "; LeRobot's reader gives frames of the others the weight 1.0" if outputs.progress else ""
        watch.note(f"{len(plan.items)} of the dataset's {num_episodes} episodes have labels{others}")
    return replace(report, files=files, summary=summary_of(labels))


@dataclass(frozen=True)
class Outputs:
    """Paths of the parts, and of the label files in the formats to write.

    prefix: of the names of the label files, as ``Dataset.label_prefix``
    """

    folder: Path
    options: LabelOptions
    prefix: str

    @classmethod
    def of(cls, dataset: Dataset, options: LabelOptions) -> Outputs:
        """Return the paths for a dataset."""
        return cls(options.output or dataset.root, options, dataset.label_prefix)

    @property
    def progress(self) -> list[Path]:
        """The progress file, then its alias."""
        named = self.folder / f"{self.prefix}{self.options.name}{PROGRESS_ENDING}"
        alias = [self.folder / f"{self.prefix}{self.options.alias}.parquet"] if self.options.alias else []
        return [named, *alias] if "progress" in self.options.formats else []

    @property
    def signals(self) -> list[Path]:
        """The file of frame signals."""
        named = self.folder / SIGNALS_FOLDER / f"{self.prefix}{self.options.name}.parquet"
        return [named] if "signals" in self.options.formats else []

    @cached_property
    def parts(self) -> Parts:
        """The finished episodes. The first access makes their folder."""
        return Parts(self.options.parts or str(self.folder / f".{self.options.name}_parts"))

    def make_folder(self) -> None:
        """Make the folder if it is missing. Raises DatasetError if labels cannot be written there."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not os.access(self.folder, os.W_OK):
                raise OSError("one that cannot be written")
        except OSError as error:
            got = f"{error.strerror or error}: name another one with --output"
            raise DatasetError.at(self.folder, "a folder for the labels", got) from error

    def before(self) -> list[LabelFile]:
        """Return the label files that exist already."""
        named = zip(self.progress, ("--name", "--alias"), strict=False)
        found = [parquet_labels(path, option) for path, option in named if path.exists()]
        return found + [parquet_labels(path) for path in self.signals if path.exists()]

    def write(self, plan: Plan, labels: Any, cost: Cost | None) -> list[Path]:
        """Write the labels to all files, and return their paths. Raises OSError.

        labels: table of ``Parts.read_all``
        cost: for the metadata; None: unknown
        """
        columns = [name for name in labels.column_names if name not in IDENTITY]
        sidecars = [progress_file(path, plan, columns, cost) for path in self.progress]
        sidecars += [signals_file(path, plan, columns, self.options.name, cost) for path in self.signals]
        try:
            write_sidecars(with_totals(labels, plan), sidecars)
        except OSError as error:
            remedy = f"make room, or name another folder with --output and this one's --parts {self.parts.url}"
            raise OSError(f"{self.folder}: expected to write the labels, got {error}: {remedy}") from error
        return [sidecar.path for sidecar in sidecars]
