# SPDX-License-Identifier: MIT
"""From a dataset and a scorer to files of labels: plan, score, put together."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rfm_client.data.datasets.hdf5 import Hdf5Dataset
from rfm_client.data.datasets.opening import open_dataset
from rfm_client.data.datasets.protocol import Dataset, DatasetError
from rfm_client.data.orientation import Orient
from rfm_client.labelling.finished_episodes import Parts
from rfm_client.labelling.hdf5_labels import check_room, hdf5_labels, sibling, write_hdf5
from rfm_client.labelling.labelled_before import LabelFile, joined, restore
from rfm_client.labelling.options import Format, LabelOptions, RayOptions
from rfm_client.labelling.plan import Plan, make_plan, selected
from rfm_client.labelling.ray_engine import Connect, Job, finish_all_with_ray
from rfm_client.labelling.recipe import Recipe
from rfm_client.labelling.run import Failure, Run, Watch
from rfm_client.labelling.scorer import Scorer
from rfm_client.labelling.sidecars import (
    Sidecar,
    parquet_labels,
    part_columns,
    progress_file,
    signals_file,
    write_sidecars,
)
from rfm_client.labelling.summary import Summary, summary_of_parts

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
    failures: Sequence[Failure]
    parts: str
    summary: Summary | None
    plan: Plan


@dataclass(frozen=True)
class Outputs:
    """Where the labels go.

    dataset: None: only the names of the Parquet files are asked for
    """

    folder: Path
    options: LabelOptions
    dataset: Dataset | None = None

    def __post_init__(self) -> None:
        of_hdf5 = isinstance(self.dataset, Hdf5Dataset)
        if self.dataset is not None and not of_hdf5 and ("hdf5" in self.options.formats or self.options.in_place):
            raise DatasetError.at("format", "progress or signals for a dataset that is no HDF5 file", "hdf5")

    def make_folder(self) -> None:
        """Makes the folder, if it is not there. Raises DatasetError if labels cannot be written there."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not os.access(self.folder, os.W_OK):
                raise OSError("one that cannot be written")
        except OSError as error:
            got = f"{error.strerror or error}: name another one with --output"
            raise DatasetError.at(self.folder, "a folder for the labels", got) from error

    @property
    def formats(self) -> Sequence[Format]:
        """Which files are written."""
        by_kind: Sequence[Format] = ("hdf5",) if isinstance(self.dataset, Hdf5Dataset) else ("progress", "signals")
        return self.options.formats or by_kind

    @property
    def parts(self) -> str:
        """Where the parts are."""
        return self.options.parts or str(self.folder / f".{self.options.name}_parts")

    @property
    def progress(self) -> list[Path]:
        """The progress file, and the same under another name."""
        names = [f"{self.options.name}_progress", *([self.options.alias] if self.options.alias else [])]
        return [self.folder / f"{name}.parquet" for name in names] if "progress" in self.formats else []

    @property
    def signals(self) -> list[Path]:
        """The file of frame signals."""
        return [self.folder / "reward_signals" / f"{self.options.name}.parquet"] if "signals" in self.formats else []

    @property
    def hdf5(self) -> list[Path]:
        """The HDF5 file: of its own, or the dataset's."""
        if "hdf5" not in self.formats or not isinstance(self.dataset, Hdf5Dataset):
            return []
        own = sibling(self.dataset, self.folder, self.options.name)
        return [self.dataset.file if self.options.in_place else own]

    def before(self) -> list[LabelFile]:
        """Those of the files that are there already. Raises DatasetError for an HDF5 file that cannot be read."""
        options = ["--name"] + ["--alias"] * (len(self.progress) - 1)
        named = [*zip(self.progress, options, strict=False), *((path, "--name") for path in self.signals)]
        found = [parquet_labels(path, option) for path, option in named]
        found += [hdf5_labels(path, self.options.name) for path in self.hdf5]
        return [each for each in found if each is not None]

    def sidecars(self, plan: Plan, columns: Sequence[str]) -> list[Sidecar]:
        """The files with these columns of the parts."""
        progress = [progress_file(path, plan, columns) for path in self.progress]
        return progress + [signals_file(path, plan, columns, self.options.name) for path in self.signals]


def plan_labels(dataset: Dataset, scorer: Scorer, options: LabelOptions, watch: Watch = _QUIET) -> Plan:
    """What would be labelled, and how; all that contradicts itself is found here, before a frame is scored.

    Raises DatasetError, and RewardError where the scorer does not answer.
    """
    recipe = Recipe.of(options, dataset, scorer.checkpoint())
    episodes = selected(dataset, options)
    recipe.check_lengths(episodes)
    for line in (*recipe.told(options), *_of_pictures(recipe, dataset, options)):
        watch.note(line)
    watch.checking(len(episodes))
    return make_plan(dataset, recipe, episodes, watch.checked)


def _of_pictures(recipe: Recipe, dataset: Dataset, options: LabelOptions) -> list[str]:
    """Which cameras are left out, and which are turned, a line each."""
    left_out = [] if options.cameras else [f"left out: {name}: {why}" for name, why in dataset.left_out.items()]
    told = " ".join(dataset.notes)
    turned = [f"orient: {name} {turn} (asked for)" for name, turn in recipe.orientations.items() if name not in told]
    return [*left_out, *dataset.notes, *turned]


def label(dataset: Dataset, scorer: Scorer, options: LabelOptions = _DEFAULTS, watch: Watch = _QUIET) -> Report:
    """Labels every frame of the chosen episodes, and writes the files. What is finished stays finished.

    An episode that fails is in the report; then no file is written, and the same call goes on with what is missing.

    Raises DatasetError before the first frame is scored for a dataset that contradicts itself, or a file of labels that
    is there and not this run's; RewardError for a scorer that is gone; OSError for a full disk.
    """
    outputs, plan, parts = _begin(dataset, scorer, options, watch)
    failures = Run(plan, dataset, scorer, parts, watch).finish_all(options.workers)
    return put_together(plan, parts, outputs, failures, watch)


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
    dataset = open_dataset(source, task=task, override_task=override_task, orient=orient)
    with connect() as scorer:
        outputs, plan, parts = _begin(dataset, scorer, options, watch)
    job = Job(source, task, connect, plan, outputs.parts, options.workers, override_task, orient)
    failures = finish_all_with_ray(job, ray, watch)
    return put_together(plan, parts, outputs, failures, watch)


def _begin(dataset: Dataset, scorer: Scorer, options: LabelOptions, watch: Watch) -> tuple[Outputs, Plan, Parts]:
    outputs = Outputs(options.output or dataset.root, options, dataset)
    if options.shard is None:
        outputs.make_folder()
    plan = plan_labels(dataset, scorer, options, watch)
    before = [] if options.shard is not None else outputs.before()
    plan = joined(plan, dataset, before, options.overwrite, watch)
    if options.in_place:
        for file in outputs.hdf5:
            check_room(file, plan)
    parts = Parts(outputs.parts)
    restore(plan, parts, before)
    return outputs, plan, parts


def put_together(
    plan: Plan, parts: Parts, outputs: Outputs, failures: Sequence[Failure], watch: Watch = _QUIET
) -> Report:
    """Writes the files, unless an episode failed or only a shard was labelled."""
    if failures or outputs.options.shard is not None:
        return Report([], failures, parts.url, None, plan)
    sidecars = outputs.sidecars(plan, part_columns(plan, parts))
    write_sidecars(plan, parts, sidecars)
    for file in outputs.hdf5:
        write_hdf5(file, plan, parts, outputs.options.name, in_place=outputs.options.in_place)
    files = [*(sidecar.path for sidecar in sidecars), *outputs.hdf5]
    num_episodes = len(outputs.dataset.episodes) if outputs.dataset is not None else len(plan.items)
    if len(plan.items) < num_episodes:
        others = "; LeRobot's reader gives frames of the others the weight 1.0" if outputs.progress else ""
        watch.note(f"{len(plan.items)} of the dataset's {num_episodes} episodes have labels{others}")
    return Report(files, [], parts.url, summary_of_parts(plan, parts), plan)
