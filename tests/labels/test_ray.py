# SPDX-License-Identifier: MIT
"""Labelling on a Ray cluster of two nodes on this machine: the same files, whatever happens to a node."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labelling import FEW, LEROBOT, BrightnessScorer, picky, slow
from rfm_client import ProgressResult, RewardError
from rfm_client.command_line import ServerOptions
from rfm_labels import LabelOptions, RayOptions, Scorer, Watch, label, label_with_ray, open_dataset
from rfm_labels.plan import plan_labels
from rfm_labels.ray_engine import EpisodeActor
from secured import Papers

pytestmark = pytest.mark.filterwarnings(
    "ignore::FutureWarning", "ignore::DeprecationWarning", "ignore::ResourceWarning"
)

ROOT = LEROBOT / "toy_v30_many"


class OpenScorer(BrightnessScorer):
    """Refuses as soon as it is closed, as a client does, and keeps the frames that it is shown."""

    def __init__(self) -> None:
        super().__init__()
        self.is_open = True
        self.seen: list[Any] = []

    def evaluate(self, samples: Any) -> list[ProgressResult]:
        if not self.is_open:
            raise RewardError("this scorer is closed")
        self.seen += [frame for sample in samples for frame in sample.trajectory.frames]
        return super().evaluate(samples)


def test_an_actor_opens_the_dataset_with_the_given_options_and_keeps_its_scorer_open(output: Path) -> None:
    scorer, told = OpenScorer(), {"task": "juggle", "override_task": True}
    told |= {"orient": "rotate90", "channels": "bgr"}

    @contextmanager
    def connect() -> Iterator[Scorer]:
        yield scorer
        scorer.is_open = False

    dataset = open_dataset(ROOT, **told)  # type: ignore[arg-type]
    plan = plan_labels(dataset, scorer, LabelOptions(output=output, limit=3, **FEW))
    actor = EpisodeActor(str(ROOT), told, connect, plan, str(output / "parts"), workers=1)
    assert actor({"places": [[0, 2]]}) == {"place": [0, 2], "reason": ["", ""]}
    assert actor({"places": [[1]]}) == {"place": [1], "reason": [""]}
    assert scorer.is_open
    del actor
    assert not scorer.is_open
    assert scorer.tasks == {"juggle"}
    stored = list(open_dataset(ROOT).frames(dataset.episodes[0], plan.recipe.cameras[0]))
    assert any(np.array_equal(frame, np.rot90(stored[-1], -1)[..., ::-1]) for frame in scorer.seen)


def test_the_options_of_a_server_with_tls_reach_an_actor(tmp_path: Path) -> None:
    (tmp_path / "key").write_text("secret")
    papers = Papers.issue(tmp_path)
    options = ServerOptions(urls=("grpcs://127.0.0.1:1",), api_key_file=tmp_path / "key", **papers.client)
    (tmp_path / "key").unlink()  # as on another machine
    received = pickle.loads(pickle.dumps(options))
    with received.client():
        assert received.credentials == options.credentials


@pytest.mark.nightly  # a minute
def test_a_cluster_goes_on_without_a_killed_node_and_one_machine_labels_the_rest(
    output: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import ray
    from ray.cluster_utils import Cluster

    support = Path(__file__).parents[1] / "support"
    monkeypatch.setenv("PYTHONPATH", str(support))  # where actors find the scorer
    monkeypatch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")  # the thread would outlive the test
    node = {"num_cpus": 2, "object_store_memory": 10**8}
    cluster = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
    killed = cluster.add_node(**node)
    ray.init(address=cluster.address, log_to_driver=False)

    class Killing(Watch):
        count = 0

        def scored(self, episode: Any) -> None:
            self.count += 1
            if self.count == 2:
                cluster.remove_node(killed, allow_graceful=False)

    by_cluster, by_both, alone = ({**FEW, "output": output / name} for name in ("cluster", "both", "alone"))
    try:
        watch, on = Killing(), RayOptions(cluster.address, actors=2)
        report = label_with_ray(str(ROOT), slow, LabelOptions(**by_cluster, workers=1), watch, ray=on)
        assert (report.failures, watch.count) == ([], 10)
        report = label_with_ray(str(ROOT), picky, LabelOptions(**by_both), ray=RayOptions(cluster.address))
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert report.files == []
    assert {str(failure.error) for failure in report.failures} == {"task: expected another one, got this"}
    rest = BrightnessScorer()
    label(open_dataset(ROOT), rest, LabelOptions(**by_both))
    assert rest.num_samples == sum(failure.episode.num_frames for failure in report.failures)
    label(open_dataset(ROOT), BrightnessScorer(), LabelOptions(**alone))
    for name in ("rfm_progress.parquet", "reward_signals/rfm.parquet"):
        assert len({(output / folder / name).read_bytes() for folder in ("cluster", "both", "alone")}) == 1
