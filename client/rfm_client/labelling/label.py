# SPDX-License-Identifier: MIT
"""From a dataset and a scorer to files of labels: plan, score, put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rfm_client.data.datasets.hdf5 import Hdf5Dataset
from rfm_client.data.datasets.opening import open_dataset
from rfm_client.data.datasets.protocol import Dataset, DatasetError
from rfm_client.labelling.finished_episodes import Parts
from rfm_client.labelling.hdf5_labels import check_hdf5_replaceable, sibling, write_hdf5
from rfm_client.labelling.options import Format, LabelOptions
from rfm_client.labelling.plan import Plan, make_plan, selected
from rfm_client.labelling.ray_engine import Connect, Job, RayOptions, finish_all_with_ray
from rfm_client.labelling.recipe import Recipe
from rfm_client.labelling.run import Failure, Run, Watch
from rfm_client.labelling.scorer import Scorer
from rfm_client.labelling.sidecars import (
    Sidecar,
    check_replaceable,
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
        if not self.folder.is_dir():
            raise DatasetError.at(self.folder, "a folder for the labels", "none")

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

    def check_replaceable(self, plan: Plan) -> None:
        """Raises DatasetError for labels that are there and are not this plan's."""
        for path in (*self.progress, *self.signals):
            check_replaceable(path, plan)
        for path in self.hdf5:
            check_hdf5_replaceable(path, plan, self.options.name)

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
    for line in recipe.told(options):
        watch.note(line)
    watch.checking(len(episodes))
    return make_plan(dataset, recipe, episodes, watch.checked)


def label(dataset: Dataset, scorer: Scorer, options: LabelOptions = _DEFAULTS, watch: Watch = _QUIET) -> Report:
    """Labels every frame of the chosen episodes, and writes the files. What is finished stays finished.

    An episode that fails is in the report; then no file is written, and the same call goes on with what is missing.

    Raises DatasetError before the first frame is scored for a dataset that contradicts itself, or a file of labels that
    is there and not this run's; RewardError for a scorer that is gone; OSError for a full disk.
    """
    outputs, plan = _begin(dataset, scorer, options, watch)
    parts = Parts(outputs.parts)
    failures = Run(plan, dataset, scorer, parts, watch).finish_all(options.workers)
    return put_together(plan, parts, outputs, failures)


def label_with_ray(
    source: str,
    connect: Connect,
    options: LabelOptions = _DEFAULTS,
    watch: Watch = _QUIET,
    *,
    task: str | None = None,
    ray: RayOptions = _ANY_CLUSTER,
) -> Report:
    """Labels as ``label`` does, on a Ray cluster, whose actors open the dataset and connect themselves.

    source, task: as in ``open_dataset``
    connect: gives a scorer, on any node; here it tells the checkpoint's facts
    """
    dataset = open_dataset(source, task=task)
    with connect() as scorer:
        outputs, plan = _begin(dataset, scorer, options, watch)
    job = Job(source, task, connect, plan, outputs.parts, options.workers)
    failures = finish_all_with_ray(job, ray, watch)
    return put_together(plan, Parts(outputs.parts), outputs, failures)


def _begin(dataset: Dataset, scorer: Scorer, options: LabelOptions, watch: Watch) -> tuple[Outputs, Plan]:
    outputs = Outputs(options.output or dataset.root, options, dataset)
    plan = plan_labels(dataset, scorer, options, watch)
    if not options.overwrite and options.shard is None:
        outputs.check_replaceable(plan)
    return outputs, plan


def put_together(plan: Plan, parts: Parts, outputs: Outputs, failures: Sequence[Failure]) -> Report:
    """Writes the files, unless an episode failed or only a shard was labelled."""
    if failures or outputs.options.shard is not None:
        return Report([], failures, parts.url, None, plan)
    sidecars = outputs.sidecars(plan, part_columns(plan, parts))
    write_sidecars(plan, parts, sidecars)
    for file in outputs.hdf5:
        write_hdf5(file, plan, parts, outputs.options.name, in_place=outputs.options.in_place)
    files = [*(sidecar.path for sidecar in sidecars), *outputs.hdf5]
    return Report(files, [], parts.url, summary_of_parts(plan, parts), plan)
