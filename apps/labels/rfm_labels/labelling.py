# SPDX-License-Identifier: MIT
"""Label a dataset: plan, score, write the label files.

Finished episodes stay in the parts. A run replaces label files only if it reproduces all their labels, or on request.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rfm_client.options import counted
from rfm_labels.audit import doubts_of_files
from rfm_labels.datasets.dataset import SIGNALS_FOLDER, Dataset
from rfm_labels.datasets.faults import DatasetError, shortened
from rfm_labels.label_files import LabelFile, reward_name
from rfm_labels.metadata import PROGRESS, SCORES, blank_from_metadata, blank_lines, skipping_in, values_of
from rfm_labels.options import DEFAULTS, QUIET, LabelOptions, Watch
from rfm_labels.plan import Plan, checked_episodes, part_key, plan_labels
from rfm_labels.scorer import Scorer
from rfm_labels.scoring import FailedEpisode, Run
from rfm_labels.summary import Summary, summary_of
from rfm_labels.writing import PROGRESS_ENDING, Parts, write_labels


@dataclass(frozen=True)
class Report:
    """The result of a labelling run.

    files: label files written; empty if an episode failed, or for a shard
    failures: episodes without labels
    parts: folder or URL that holds the finished episodes
    summary: None: no file was written
    plan: the episodes to label, and the recipe
    """

    files: Sequence[Path]
    failures: Sequence[FailedEpisode]
    parts: str
    summary: Summary | None
    plan: Plan


def label(dataset: Dataset, scorer: Scorer, options: LabelOptions = DEFAULTS, watch: Watch = QUIET) -> Report:
    """Label every frame in the chosen episodes, and write the label files.

    If an episode fails, the report names it, and no label file is written. The same call then labels only the missing
    episodes.

    Raises DatasetError, before scoring starts, if the dataset is contradictory or this run may not replace a label
    file; RewardError if the scorer is gone; OSError if the disk is full.
    """
    outputs = Outputs.of(dataset, options)
    plan = planned(dataset, scorer, outputs, watch, writes=True)
    failures = Run(plan, dataset, scorer, outputs.parts, watch).finish_all(options.workers)
    return put_together(plan, dataset, outputs, failures, watch)


def planned(dataset: Dataset, scorer: Scorer, outputs: Outputs, watch: Watch = QUIET, *, writes: bool = False) -> Plan:
    """Check everything that the run needs before scoring starts, and return the plan.

    writes: True: create the folder for the label files, and note doubts that need no decoding

    Raises DatasetError, also for existing label files that this run may not replace.
    """
    options = outputs.options
    if writes and options.shard is None:
        outputs.make_folder()
    plan = plan_labels(dataset, scorer, options, watch)
    for file in outputs.before() if options.shard is None else ():
        try:
            file.check(plan)
        except DatasetError as error:
            if not options.overwrite:
                option = "--alias" if file.path in outputs.progress[1:] else "--name"
                problem = f"{error.problem}: choose another {option}, or --overwrite"
                raise DatasetError(problem, error.where) from error
            labels = f"its labels of {counted(len(file.digests), 'episode')} are" if file.digests else "it is"
            watch.note(f"--overwrite: {error}; {labels} replaced")
    for alias in outputs.left_behind(plan) if options.shard is None else ():
        remedy = f"add --alias {alias} --overwrite to replace them there, too"
        watch.note(f"{outputs.prefix}{alias}.parquet keeps the labels that this run replaces: {remedy}")
    checked_episodes(dataset, options, watch)  # after the cheap refusals
    doubts = doubts_of_files(dataset, plan.episodes, plan.recipe.decoded_cameras) if writes else []
    for line in shortened([f"doubt: {doubt}" for doubt in doubts]):
        watch.note(line)
    return plan


def put_together(
    plan: Plan, dataset: Dataset, outputs: Outputs, failures: Sequence[FailedEpisode], watch: Watch
) -> Report:
    """Write the label files, unless an episode failed or the run labelled only a shard."""
    report = Report([], failures, outputs.parts.url, None, plan)
    if failures or outputs.options.shard is not None:
        return report
    labels = outputs.parts.read_all(plan)
    blank = blank_from_metadata(labels.schema.metadata)
    for line in blank_lines(blank, len(plan.items)):
        watch.note(line)
    files = outputs.write(plan, labels)
    for name, score in SCORES.items():
        if name in labels.column_names and (note := score.mark_note(values_of(labels[name]))):
            watch.note(f"{note}; the column {name} marks them")
    if outputs.progress and skipping_in(labels.column_names):
        skipped = np.isnan(values_of(labels[PROGRESS])).sum()
        watch.note(f"progress_sparse: filled at the {skipped} of {len(labels)} frames that the model skipped")
    num_episodes = len(dataset.numbers)
    if len(plan.items) < num_episodes:
        others = "; LeRobot's reader gives frames of the others the weight 1.0" if outputs.progress else ""
        watch.note(f"{len(plan.items)} of the dataset's {num_episodes} episodes have labels{others}")
    return replace(report, files=files, summary=summary_of(labels, plan.names))


@dataclass(frozen=True)
class Outputs:
    """Paths for the parts and the label files.

    prefix: starts each label file's name, as in ``Dataset.label_prefix``
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
        """The frame signal file."""
        named = self.folder / SIGNALS_FOLDER / f"{self.prefix}{self.options.name}.parquet"
        return [named] if "signals" in self.options.formats else []

    @cached_property
    def parts(self) -> Parts:
        """The finished episodes. First access creates their folder."""
        return Parts(self.options.parts or str(self.folder / f".{self.options.name}_parts"))

    def parts_of(self, file: LabelFile) -> str:
        """Return the parts with all labels of a file, from which the run that made it writes it again; empty: none."""
        keys = {part_key(*each) for each in file.digests.items()}
        own = self.folder / f".{self.options.name}_parts"  # an alias has none
        found = sorted(self.folder.glob(".*_parts"), key=lambda folder: (folder != own, folder))
        there = [str(folder) for folder in found if folder.is_dir() and os.access(folder, os.R_OK)]
        places = [self.options.parts] if self.options.parts else there
        return next((place for place in places if keys and keys <= Parts(place).keys()), "")

    def make_folder(self) -> None:
        """Create the folder if it is missing. Raises DatasetError if it is not writable."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not os.access(self.folder, os.W_OK):
                raise OSError("one that cannot be written")
        except OSError as error:
            got = f"{error.strerror or error}: name another one with --output"
            raise DatasetError.at(self.folder, "a folder for the labels", got) from error

    def before(self, alias: str = "") -> list[LabelFile]:
        """Return the existing label files; with an alias, those of the label that its file belongs to."""
        file = self.folder / f"{self.prefix}{alias}.parquet"
        if alias and file.exists():
            label_of = replace(self.options, name=reward_name(Path(f"{alias}.parquet")))
            return replace(self, options=label_of).before() or [LabelFile.read(file)]
        return [LabelFile.read(path) for path in [*self.progress, *self.signals] if path.exists()]

    def left_behind(self, plan: Plan) -> list[str]:
        """Return the aliases, not asked for now, of existing labels that the plan replaces by others."""
        planned = {item.episode.index: item.digest for item in plan.items}
        replaced = [file.digests for file in self.before() if file.digests not in ({}, planned)]
        others = sorted({*self.folder.glob(f"{glob.escape(self.prefix)}[!.]*.parquet")} - {*self.progress})
        stale = [file for file in others if LabelFile.read(file).digests in replaced]
        return [file.stem.removeprefix(self.prefix) for file in stale]

    def write(self, plan: Plan, labels: Any) -> list[Path]:
        """Write the labels, a table from ``Parts.read_all``, to all files, and return their paths. Raises OSError."""
        try:
            return write_labels(labels, plan, self.progress, self.signals, self.options.name)
        except OSError as error:
            remedy = f"make room, or name another folder with --output and this one's --parts {self.parts.url}"
            raise OSError(f"{self.folder}: expected to write the labels, got {error}: {remedy}") from error
