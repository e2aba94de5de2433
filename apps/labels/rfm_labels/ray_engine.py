# SPDX-License-Identifier: MIT
"""Label on a Ray cluster: Ray Data hands episodes to actors that each hold a scorer. Needs ``rfm-labels[ray]``.

Ray only schedules. Parts and provenance equal those from a run without Ray, so either run can continue the other. Every
node must find the dataset and the parts at the same place: a shared folder or, for the parts, a URL.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

from rfm_client import RewardError
from rfm_labels.datasets.opening import open_dataset
from rfm_labels.labelling import Outputs, Report, planned, put_together
from rfm_labels.options import DEFAULTS, QUIET, LabelOptions, RayOptions, Watch
from rfm_labels.plan import Plan
from rfm_labels.scorer import Scorer
from rfm_labels.scoring import FailedEpisode, Run, by_episode, unfinished
from rfm_labels.writing import Parts

Connect: TypeAlias = Callable[[], AbstractContextManager[Scorer]]

_BATCHES_AN_ACTOR = 4  # minimum, given enough episodes: all actors then end at about the same time
_ANY_CLUSTER = RayOptions()


@dataclass(frozen=True)
class RayJob:
    """The work that all actors share.

    source, opening: arguments for ``open_dataset``
    connect: returns a context with the actor's scorer
    parts: folder or URL for the parts
    workers: concurrent episodes per actor
    """

    source: str
    opening: Mapping[str, Any]
    connect: Connect
    plan: Plan
    parts: str
    workers: int


class EpisodeActor:
    """Labels batches of episodes, scoring one episode while it decodes the next."""

    def __init__(self, job: RayJob) -> None:
        self._held = ExitStack()  # closed by ``__del__``, also if ``__init__`` fails
        self._job = job
        self._parts = Parts(job.parts)
        self._dataset = open_dataset(job.source, **job.opening)
        self._scorer = self._held.enter_context(job.connect())

    def __del__(self) -> None:
        """Close the scorer: Ray releases the actor object before the actor ends."""
        self._held.close()

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, list[Any]]:
        """Label the episodes at these places in the plan. Return a reason for each; empty if it did not fail."""
        (places,) = batch["places"]
        plan = replace(self._job.plan, items=[self._job.plan.items[int(place)] for place in places])
        failures = Run(plan, self._dataset, self._scorer, self._parts, Watch()).finish_all(self._job.workers)
        reasons = {failure.episode.index: str(failure.error) for failure in failures}
        return {
            "place": [int(place) for place in places],
            "reason": [reasons.get(item.episode.index, "") for item in plan.items],
        }


def finish_all_with_ray(job: RayJob, options: RayOptions, watch: Watch) -> list[FailedEpisode]:
    """Label all items without a part on a cluster, and return the failures. Raises RewardError if an actor stops."""
    try:
        import ray
        import ray.data
    except ImportError as error:
        raise ImportError('labelling on a cluster needs Ray: pip install ./client "./apps/labels[ray]"') from error
    pending = {item.key for item in unfinished(job.plan, Parts(job.parts), watch)}
    places = [place for place, item in enumerate(job.plan.items) if item.key in pending]
    if not places:
        return []
    if not ray.is_initialized():
        ray.init(address=options.address, log_to_driver=False, include_dashboard=False)
    failures = []
    try:
        for row in _labelled(ray, job, options, places).iter_rows():
            episode = job.plan.items[row["place"]].episode
            if row["reason"]:
                failures.append(FailedEpisode(episode, RewardError(row["reason"])))
                watch.failed(episode, failures[-1].error)
            else:
                watch.scored(episode)
    except ray.exceptions.RayError as error:
        raise RewardError(f"ray: expected actors that label, got {str(error).strip().splitlines()[-1]}") from error
    return by_episode(failures)


def _labelled(ray: Any, job: RayJob, options: RayOptions, places: Sequence[int]) -> Any:
    """The Ray dataset whose rows arrive as batches are labelled."""
    ray.data.DataContext.get_current().enable_progress_bars = False
    # a batch occupies all workers in an actor, given enough episodes
    size = max(1, min(job.workers, len(places) // (options.actors * _BATCHES_AN_ACTOR)))
    batches = [list(places[start : start + size]) for start in range(0, len(places), size)]
    dataset = ray.data.from_items([{"places": batch} for batch in batches], override_num_blocks=len(batches))
    return dataset.map_batches(
        EpisodeActor,
        fn_constructor_args=(job,),
        batch_size=1,
        batch_format="numpy",
        compute=ray.data.ActorPoolStrategy(size=min(options.actors, len(batches))),
        num_gpus=options.num_gpus_per_actor,
    )


def label_with_ray(
    source: str,
    connect: Connect,
    options: LabelOptions = DEFAULTS,
    watch: Watch = QUIET,
    *,
    ray: RayOptions = _ANY_CLUSTER,
    **opening: Any,
) -> Report:
    """Label like ``label``, on a Ray cluster. Each actor opens the dataset and connects on its own.

    source, opening: arguments for ``open_dataset``
    connect: returns a context with a scorer, on any node; this process uses it to read the checkpoint's facts
    """
    dataset = open_dataset(source, **opening)
    with connect() as scorer:
        outputs = Outputs.of(dataset, options)
        plan = planned(dataset, scorer, outputs, watch, writes=True)
    job = RayJob(source, opening, connect, plan, outputs.parts.url, options.workers)
    failures = finish_all_with_ray(job, ray, watch)
    return put_together(plan, dataset, outputs, failures, watch)
