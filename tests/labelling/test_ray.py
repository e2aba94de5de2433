# SPDX-License-Identifier: MIT
"""Labelling on a Ray cluster of two nodes on this machine: the same files, whatever happens to a node."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

from labelling import LEROBOT, BrightnessScorer, absent, picky, slow
from rfm.launch.process import Endpoints
from rfm_client import ProgressResult, RewardClient, RewardError
from rfm_client.data.orientation import Orient
from rfm_client.labelling import (
    ClientScorer,
    LabelOptions,
    RayOptions,
    Scorer,
    Watch,
    label,
    label_with_ray,
    open_dataset,
)
from rfm_client.labelling.label import plan_labels
from rfm_client.labelling.ray_engine import EpisodeActor, RayJob

pytestmark = pytest.mark.filterwarnings(
    "ignore::FutureWarning", "ignore::DeprecationWarning", "ignore::ResourceWarning"
)

ROOT = LEROBOT / "toy_v30_many"
FILES = ("rfm_progress.parquet", "reward_signals/rfm.parquet")
SUPPORT = Path(__file__).parents[1] / "support"


def contents(output: Path) -> list[bytes]:
    return [(output / name).read_bytes() for name in FILES]


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


def test_an_actor_opens_the_dataset_as_it_is_told_and_its_scorer_for_as_long_as_it_lives(output: Path) -> None:
    scorer, told = OpenScorer(), {"task": "juggle", "override_task": True, "orient": Orient("rotate90")}

    @contextmanager
    def connect() -> Iterator[Scorer]:
        yield scorer
        scorer.is_open = False

    dataset = open_dataset(ROOT, **told)  # type: ignore[arg-type]
    plan = plan_labels(dataset, scorer, LabelOptions(output=output, limit=3, cameras=(dataset.cameras[0],)))
    actor = EpisodeActor(RayJob(str(ROOT), told, connect, plan, str(output / "parts"), workers=1))
    assert actor({"places": [[0, 2]]}) == {"place": [0, 2], "reason": ["", ""]}
    assert actor({"places": [[1]]}) == {"place": [1], "reason": [""]}
    assert scorer.is_open
    del actor
    assert not scorer.is_open
    assert scorer.tasks == {"juggle"}
    stored = list(open_dataset(ROOT).frames(dataset.episodes[0], dataset.cameras[0]))
    assert any(np.array_equal(frame, np.rot90(stored[-1], -1)) for frame in scorer.seen)


@pytest.fixture
def undisturbed(tmp_path: Path) -> list[bytes]:
    folder = tmp_path / "undisturbed"
    folder.mkdir()
    label(open_dataset(ROOT), BrightnessScorer(), LabelOptions(output=folder))
    return contents(folder)


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    import ray
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", str(SUPPORT))  # where actors find the scorer
    monkeypatch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")  # its thread would outlive the test
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 2, "object_store_memory": 10**8, "include_dashboard": False}
    )
    cluster.add_node(num_cpus=2, object_store_memory=10**8)
    ray.init(address=cluster.address, log_to_driver=False)
    yield cluster
    ray.shutdown()
    cluster.shutdown()


@pytest.mark.slow
def test_a_cluster_goes_on_without_a_node_that_is_killed_and_writes_what_one_process_writes(
    cluster: Any, output: Path, undisturbed: list[bytes]
) -> None:
    node = cluster.add_node(num_cpus=2, object_store_memory=10**8)

    class Killing(Watch):
        count = 0

        def scored(self, episode: Any) -> None:
            self.count += 1
            if self.count == 2:
                cluster.remove_node(node, allow_graceful=False)

    watch = Killing()
    options = LabelOptions(output=output, workers=1)
    report = label_with_ray(str(ROOT), slow, options, watch, ray=RayOptions(cluster.address, actors=3))
    assert (report.failures, watch.count) == ([], 10)
    assert contents(output) == undisturbed


@pytest.mark.slow
def test_one_machine_goes_on_with_what_a_cluster_has_left(cluster: Any, output: Path, undisturbed: list[bytes]) -> None:
    options, on = LabelOptions(output=output), RayOptions(cluster.address, actors=2)
    report = label_with_ray(str(ROOT), absent, options, ray=on)
    assert [str(failure.error) for failure in report.failures] == ["no server"] * 10
    report = label_with_ray(str(ROOT), picky, options, ray=on)
    assert report.files == []
    assert {str(failure.error) for failure in report.failures} == {"task: expected another one, got this"}
    rest = BrightnessScorer()
    label(open_dataset(ROOT), rest, options)
    assert rest.num_samples == 2 * sum(failure.episode.num_frames for failure in report.failures)
    assert contents(output) == undisturbed


@pytest.mark.triton
@pytest.mark.slow
def test_actors_ask_a_server_for_all_of_their_episodes(cluster: Any, output: Path, demo_server: Endpoints) -> None:
    url = demo_server.grpc_url

    @contextmanager
    def connect() -> Iterator[Scorer]:
        with RewardClient(url) as client:
            yield ClientScorer(client)

    (output / "one").mkdir()
    options = LabelOptions(output=output, limit=4, frames=4, workers=1)
    report = label_with_ray(str(ROOT), connect, options, ray=RayOptions(cluster.address, actors=2))
    assert report.failures == []
    with connect() as scorer:
        label(open_dataset(ROOT), scorer, LabelOptions(output=output / "one", limit=4, frames=4))
    of_cluster, of_one = (parquet.read_table(folder / FILES[0]) for folder in (output, output / "one"))
    np.testing.assert_allclose(of_cluster["progress_sparse"], of_one["progress_sparse"], rtol=0, atol=1e-5)
