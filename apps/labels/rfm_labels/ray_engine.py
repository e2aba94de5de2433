# SPDX-License-Identifier: MIT
"""Label on a Ray cluster: Ray Data hands episodes to actors that each hold a scorer. Needs ``rfm-labels[ray]``.

Ray only schedules. Parts and provenance equal those from a run without Ray, so either run can continue the other. Every
node must find the dataset and the parts at the same place: a shared folder or, for the parts, a URL.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from typing import Any, TypeAlias

from rfm_client import RewardError
from rfm_labels.datasets.opening import open_dataset
from rfm_labels.labelling import Outputs, Report, planned, put_together
from rfm_labels.options import DEFAULTS, QUIET, LabelOptions, RayOptions, Watch
from rfm_labels.plan import Plan
from rfm_labels.scorer import Scorer
from rfm_labels.scoring import FailedEpisode, Run, unfinished
from rfm_labels.writing import Parts

Connect: TypeAlias = Callable[[], AbstractContextManager[Scorer]]

_BATCHES_AN_ACTOR = 4  # minimum, given enough episodes: all actors then end at about the same time
_ANY_CLUSTER = RayOptions()


class EpisodeActor:
    """Labels batches of episodes, scoring one episode while it decodes the next.

    source, opening, connect: as in ``label_with_ray``
    parts: folder or URL for the parts
    workers: concurrent episodes
    """

    def __init__(
        self, source: str, opening: Mapping[str, Any], connect: Connect, plan: Plan, parts: str, workers: int
    ) -> None:
        self._held = ExitStack()  # closed by ``__del__``, also if ``__init__`` fails
        self._plan, self._parts, self._workers = plan, Parts(parts), workers
        self._dataset = open_dataset(source, **opening)
        self._scorer = self._held.enter_context(connect())

    def __del__(self) -> None:
        """Close the scorer: Ray releases the actor object before the actor ends."""
        self._held.close()

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, list[Any]]:
        """Label the episodes at these places in the plan. Return a reason for each; empty if it did not fail."""
        places = [int(place) for place in batch["places"][0]]
        plan = replace(self._plan, items=[self._plan.items[place] for place in places])
        failures = Run(plan, self._dataset, self._scorer, self._parts, Watch()).finish_all(self._workers)
        reasons = {failure.episode.index: str(failure.error) for failure in failures}
        return {"place": places, "reason": [reasons.get(item.episode.index, "") for item in plan.items]}


def _finish_all(
    plan: Plan, places: Sequence[int], actor: Sequence[Any], workers: int, options: RayOptions, watch: Watch
) -> list[FailedEpisode]:
    """Label the items at these places on a cluster, and return the failures. Raises RewardError if an actor stops.

    actor: arguments for ``EpisodeActor``
    """
    try:
        import ray
        import ray.data
    except ImportError as error:
        raise ImportError('labelling on a cluster needs Ray: pip install ./client "./apps/labels[ray]"') from error
    if not ray.is_initialized():
        ray.init(address=options.address, log_to_driver=False, include_dashboard=False)
    ray.data.DataContext.get_current().enable_progress_bars = False
    # a batch occupies all workers in an actor, given enough episodes
    size = max(1, min(workers, len(places) // (options.actors * _BATCHES_AN_ACTOR)))
    batches = [list(places[start : start + size]) for start in range(0, len(places), size)]
    dataset = ray.data.from_items([{"places": batch} for batch in batches], override_num_blocks=len(batches))
    labelled = dataset.map_batches(
        EpisodeActor,
        fn_constructor_args=actor,
        batch_size=1,
        batch_format="numpy",
        compute=ray.data.ActorPoolStrategy(size=min(options.actors, len(batches))),
        num_gpus=options.num_gpus_per_actor,
    )
    failures = []
    try:
        for row in labelled.iter_rows():
            episode = plan.items[row["place"]].episode
            if row["reason"]:
                failures.append(FailedEpisode(episode, RewardError(row["reason"])))
                watch.failed(episode, failures[-1].error)
            else:
                watch.scored(episode)
    except ray.exceptions.RayError as error:
        raise RewardError(f"ray: expected actors that label, got {str(error).strip().splitlines()[-1]}") from error
    return sorted(failures, key=lambda failure: failure.episode.index)


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
    pending = {item.key for item in unfinished(plan, outputs.parts, watch)}
    places = [place for place, item in enumerate(plan.items) if item.key in pending]
    actor = (source, opening, connect, plan, outputs.parts.url, options.workers)
    failures = _finish_all(plan, places, actor, options.workers, ray, watch) if places else []
    return put_together(plan, dataset, outputs, failures, watch)
