# SPDX-License-Identifier: MIT
"""From a dataset and a scorer to files of labels: plan, score, put together."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from rfm_client.data.datasets.hdf5 import Hdf5Dataset
from rfm_client.data.datasets.opening import open_dataset
from rfm_client.data.datasets.protocol import Dataset, DatasetError, require
from rfm_client.data.orientation import Orient
from rfm_client.labelling.finished_episodes import IDENTITY, Parts
from rfm_client.labelling.hdf5_labels import check_room, hdf5_labels, write_hdf5
from rfm_client.labelling.label_files import (
    PROGRESS_ENDING,
    SIGNALS_FOLDER,
    parquet_labels,
    progress_file,
    signals_file,
    write_sidecars,
)
from rfm_client.labelling.labelled_before import LabelFile, joined, restore
from rfm_client.labelling.options import Format, LabelOptions, RayOptions
from rfm_client.labelling.plan import Item, Plan, Recipe, make_plan, selected
from rfm_client.labelling.ray_engine import Connect, RayJob, finish_all_with_ray
from rfm_client.labelling.run import FailedEpisode, Run, Watch
from rfm_client.labelling.scorer import Scorer
from rfm_client.labelling.summary import Summary, summary_of

_DEFAULTS = LabelOptions()
_QUIET = Watch()
_ANY_CLUSTER = RayOptions()


@dataclass(frozen=True)
class Report:
    """What a run has done.

    files: that were written; none if an episode failed, or if only a shard was labelled
    failures: episodes without labels
    parts: where the finished episodes are
    summary: None: no file was written
    plan: which episodes were to be labelled, and how
    """

    files: Sequence[Path]
    failures: Sequence[FailedEpisode]
    parts: str
    summary: Summary | None
    plan: Plan


@dataclass(frozen=True)
class Outputs:
    """Where the labels go. dataset: None: only the names of the Parquet files are asked for"""

    folder: Path
    options: LabelOptions
    dataset: Dataset | None = None

    def __post_init__(self) -> None:
        is_written = self.dataset is None or isinstance(self.dataset, Hdf5Dataset)
        expected = "progress or signals for a dataset that is no HDF5 file"
        require("format", is_written or not ("hdf5" in self.options.formats or self.options.in_place), expected, "hdf5")

    @property
    def formats(self) -> Sequence[Format]:
        """Which files are written."""
        by_kind: Sequence[Format] = ("hdf5",) if isinstance(self.dataset, Hdf5Dataset) else ("progress", "signals")
        return self.options.formats or by_kind

    @property
    def progress(self) -> list[Path]:
        """The progress file, and the same under another name."""
        named = self.folder / f"{self.options.name}{PROGRESS_ENDING}"
        alias = [self.folder / f"{self.options.alias}.parquet"] if self.options.alias else []
        return [named, *alias] if "progress" in self.formats else []

    @property
    def signals(self) -> list[Path]:
        """The file of frame signals."""
        return [self.folder / SIGNALS_FOLDER / f"{self.options.name}.parquet"] if "signals" in self.formats else []

    @property
    def hdf5(self) -> list[Path]:
        """The HDF5 file: of its own, or the dataset's."""
        if "hdf5" not in self.formats or not isinstance(self.dataset, Hdf5Dataset):
            return []
        own = self.folder / f"{self.dataset.file.stem}.{self.options.name}_rewards.hdf5"
        return [self.dataset.file if self.options.in_place else own]

    @cached_property
    def parts(self) -> Parts:
        """The finished episodes. Makes their folder."""
        return Parts(self.options.parts or str(self.folder / f".{self.options.name}_parts"))

    def make_folder(self) -> None:
        """Makes the folder, if it is not there. Raises DatasetError if labels cannot be written there."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not os.access(self.folder, os.W_OK):
                raise OSError("one that cannot be written")
        except OSError as error:
            got = f"{error.strerror or error}: name another one with --output"
            raise DatasetError.at(self.folder, "a folder for the labels", got) from error

    def before(self) -> list[LabelFile]:
        """Those of the files that are there already. Raises DatasetError for an HDF5 file that cannot be read."""
        named = zip(self.progress, ("--name", "--alias"), strict=False)
        found = [parquet_labels(path, option) for path, option in named]
        found += [parquet_labels(path) for path in self.signals]
        found += [hdf5_labels(path, self.options.name) for path in self.hdf5]
        return [each for each in found if each is not None]

    def write(self, plan: Plan, labels: Any) -> list[Path]:
        """Writes the labels, those of all parts, to all files. Raises OSError."""
        columns = [name for name in labels.column_names if name not in IDENTITY]
        sidecars = [progress_file(path, plan, columns) for path in self.progress]
        sidecars += [signals_file(path, plan, columns, self.options.name) for path in self.signals]
        try:
            write_sidecars(labels, sidecars)
        except OSError as error:
            remedy = f"make room, or name another folder with --output and this one's --parts {self.parts.url}"
            raise OSError(f"{self.folder}: expected to write the labels, got {error}: {remedy}") from error
        for file in self.hdf5:
            write_hdf5(file, plan, labels, self.options.name, in_place=self.options.in_place)
        return [*(sidecar.path for sidecar in sidecars), *self.hdf5]


def plan_labels(dataset: Dataset, scorer: Scorer, options: LabelOptions, watch: Watch = _QUIET) -> Plan:
    """What would be labelled, and how; all that contradicts itself is found here, but for missing frames.

    Raises DatasetError, and RewardError where the scorer does not answer.
    """
    recipe = Recipe.of(options, dataset, scorer.checkpoint())
    episodes = selected(dataset, options)
    recipe.check_lengths(episodes)
    told = " ".join(dataset.notes)
    turned = [f"orient: {name} {turn} (asked for)" for name, turn in recipe.orientations.items() if name not in told]
    left_out = [] if options.cameras else [f"left out: {name}: {why}" for name, why in dataset.left_out.items()]
    for line in (*recipe.told(options), *left_out, *dataset.notes, *turned):
        watch.note(line)
    return make_plan(dataset, recipe, episodes)


def check_frames(dataset: Dataset, recipe: Recipe, items: Sequence[Item], watch: Watch = _QUIET) -> int:
    """Finds every frame of these episodes. Gives how many bytes they take as they are stored; raises DatasetError."""
    watch.checking(len(items))
    num_bytes = 0
    for item in items:
        num_bytes += sum(dataset.check(item.episode, camera) for camera in recipe.cameras)
        watch.checked(item.episode)
    return num_bytes


def label(dataset: Dataset, scorer: Scorer, options: LabelOptions = _DEFAULTS, watch: Watch = _QUIET) -> Report:
    """Labels every frame of the chosen episodes, and writes the files. What is finished stays finished.

    An episode that fails is in the report; then no file is written, and the same call goes on with what is missing.

    Raises DatasetError before the first frame is scored for a dataset that contradicts itself, or a file of labels that
    is there and not this run's; RewardError for a scorer that is gone; OSError for a full disk.
    """
    outputs, plan = _begin(dataset, scorer, options, watch)
    failures = Run(plan, dataset, scorer, outputs.parts, watch).finish_all(options.workers)
    return _put_together(plan, outputs, failures, watch)


def label_with_ray(
    source: str,
    connect: Connect,
    options: LabelOptions = _DEFAULTS,
    watch: Watch = _QUIET,
    *,
    task: str | None = None,
    override_task: bool = False,
    orient: Orient = Orient(),
    ray: RayOptions = _ANY_CLUSTER,
) -> Report:
    """Labels as ``label`` does, on a Ray cluster, whose actors open the dataset and connect themselves.

    source, task, override_task, orient: as in ``open_dataset``
    connect: gives a scorer, on any node; here it tells the checkpoint's facts
    """
    opening = {"task": task, "override_task": override_task, "orient": orient}
    dataset = open_dataset(source, task=task, override_task=override_task, orient=orient)
    with connect() as scorer:
        outputs, plan = _begin(dataset, scorer, options, watch)
    job = RayJob(source, opening, connect, plan, outputs.parts.url, options.workers)
    failures = finish_all_with_ray(job, ray, watch)
    return _put_together(plan, outputs, failures, watch)


def _begin(dataset: Dataset, scorer: Scorer, options: LabelOptions, watch: Watch) -> tuple[Outputs, Plan]:
    """The plan, when all of its frames that have no labels yet are known to be there."""
    outputs = Outputs(options.output or dataset.root, options, dataset)
    before: list[LabelFile] = []
    if options.shard is None:
        outputs.make_folder()
        before = outputs.before()
    plan = joined(plan_labels(dataset, scorer, options, watch), dataset, before, options.overwrite, watch)
    if options.in_place:
        for file in outputs.hdf5:
            check_room(file, plan)
    restore(plan, outputs.parts, before)
    finished = outputs.parts.finished(plan.items)
    pending = [item for item in plan.items if item.key not in finished]
    check_frames(dataset, plan.recipe, pending, watch)
    return outputs, plan


def _put_together(plan: Plan, outputs: Outputs, failures: Sequence[FailedEpisode], watch: Watch) -> Report:
    """Writes the files, unless an episode failed or only a shard was labelled."""
    report = Report([], failures, outputs.parts.url, None, plan)
    if failures or outputs.options.shard is not None:
        return report
    labels = outputs.parts.read_all(plan)
    files = outputs.write(plan, labels)
    assert outputs.dataset is not None  # of a run
    num_episodes = len(outputs.dataset.episodes)
    if len(plan.items) < num_episodes:
        others = "; LeRobot's reader gives frames of the others the weight 1.0" if outputs.progress else ""
        watch.note(f"{len(plan.items)} of the dataset's {num_episodes} episodes have labels{others}")
    return replace(report, files=files, summary=summary_of(labels))
