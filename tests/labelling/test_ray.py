# SPDX-License-Identifier: MIT
"""Labelling on a Ray cluster of two nodes on this machine: the same files, whatever happens to a node."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from labelling import LEROBOT, BrightnessScorer, absent, picky, slow
from rfm_client.labelling import LabelOptions, RayOptions, Watch, label, label_with_ray, open_dataset

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning", "ignore::ResourceWarning"),
]

ROOT = LEROBOT / "toy_v30_many"
FILES = ("rfm_progress.parquet", "reward_signals/rfm.parquet")
SUPPORT = Path(__file__).parents[1] / "support"


def contents(output: Path) -> list[bytes]:
    return [(output / name).read_bytes() for name in FILES]


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
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 2, "object_store_memory": 10**8, "include_dashboard": False}
    )
    cluster.add_node(num_cpus=2, object_store_memory=10**8)
    ray.init(address=cluster.address, log_to_driver=False)
    yield cluster
    ray.shutdown()
    cluster.shutdown()


def test_a_cluster_writes_the_files_that_one_process_writes(
    cluster: Any, output: Path, undisturbed: list[bytes]
) -> None:
    report = label_with_ray(
        str(ROOT), slow, LabelOptions(output=output, workers=2), ray=RayOptions(cluster.address, actors=2)
    )
    assert report.failures == []
    assert contents(output) == undisturbed


def test_a_cluster_goes_on_without_a_node_that_is_killed(cluster: Any, output: Path, undisturbed: list[bytes]) -> None:
    node = cluster.add_node(num_cpus=2, object_store_memory=10**8)

    class Killing(Watch):
        count = 0

        def scored(self, episode: Any) -> None:
            self.count += 1
            if self.count == 2:
                cluster.remove_node(node, allow_graceful=False)

    watch = Killing()
    options = LabelOptions(output=output, workers=1)
    label_with_ray(str(ROOT), slow, options, watch, ray=RayOptions(cluster.address, actors=3))
    assert watch.count == 10
    assert contents(output) == undisturbed


def test_one_machine_goes_on_with_what_a_cluster_has_left(cluster: Any, output: Path, undisturbed: list[bytes]) -> None:
    options = LabelOptions(output=output)
    report = label_with_ray(str(ROOT), picky, options, ray=RayOptions(cluster.address, actors=2))
    assert report.files == []
    assert {str(failure.error) for failure in report.failures} == {"task: expected another one, got this"}
    rest = BrightnessScorer()
    label(open_dataset(ROOT), rest, options)
    assert rest.num_samples == 2 * sum(failure.episode.num_frames for failure in report.failures)
    assert contents(output) == undisturbed


def test_what_no_actor_can_label_is_told(cluster: Any, output: Path) -> None:
    report = label_with_ray(str(ROOT), absent, LabelOptions(output=output), ray=RayOptions(cluster.address))
    assert [str(failure.error) for failure in report.failures] == ["no server"] * 10
