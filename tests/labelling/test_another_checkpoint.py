# SPDX-License-Identifier: MIT
"""Another checkpoint is served while a dataset is labelled. The servers are stand-ins, whose checkpoint tests replace."""

from __future__ import annotations

from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

from labelling import LEROBOT
from rfm_client import InferenceFailedError, InvalidSampleError, ProgressResult, RewardClient
from rfm_client.data.sampling import Sampling, of_prefixes
from rfm_client.labelling import ClientScorer, LabelOptions, label, open_dataset
from shelves import V1, V2, Kept, Shelf

ROOT = LEROBOT / "toy_v30_many"


def labelled(output: Path, *shelves: Shelf) -> None:
    with RewardClient("", transports=shelves) as client:
        label(open_dataset(ROOT), ClientScorer(client), LabelOptions(output=output, workers=1))


def stored(output: Path) -> list[Any]:
    """The progress of each episode that has a part."""
    files = sorted((output / ".rfm_parts").glob("*.parquet"))
    return [parquet.read_table(file)["progress"].to_numpy() for file in files]


def assert_of_one_checkpoint(parts: list[Any]) -> None:
    for progress in parts:
        assert (progress == np.float32(V1.score)).all()


@pytest.fixture(scope="module", params=[True, False], ids=["embeddings", "frames"])
def has_encoder(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.fixture(scope="module")
def half(has_encoder: bool, tmp_path_factory: pytest.TempPathFactory) -> int:
    """Half of the requests that all episodes take."""
    shelf = Shelf(has_encoder=has_encoder)
    labelled(tmp_path_factory.mktemp("whole"), shelf)
    return shelf.count // 2


@pytest.mark.parametrize("other", [V2, Kept(0.9, weights="weights-of-v2"), Kept(0.9, settings="settings-of-v2")])
def test_a_run_stops_when_another_checkpoint_is_served(output: Path, has_encoder: bool, half: int, other: Kept) -> None:
    with pytest.raises(InvalidSampleError, match=r"_digest: expected \w+-of-v1, got \w+-of-v2|settings_digest"):
        labelled(output, Shelf(other=other, after=half, has_encoder=has_encoder))
    assert 0 < len(stored(output)) < len(open_dataset(ROOT).episodes)
    assert_of_one_checkpoint(stored(output))
    assert not (output / "rfm_progress.parquet").exists()


@pytest.mark.parametrize("part", ["rfm", "rfm_encoder"])
def test_a_run_stops_in_the_middle_of_a_rollout(output: Path, part: str) -> None:
    shelf = Shelf()
    labelled(output, shelf)
    rmtree(output)  # the labels too, or they would be kept
    output.mkdir()
    with pytest.raises(InvalidSampleError, match="settings_digest"):
        labelled(output, Shelf(after=shelf.count // 2, parts=(part,)))
    assert_of_one_checkpoint(stored(output))
    assert 0 < len(stored(output)) < len(open_dataset(ROOT).episodes)


def test_servers_that_are_replaced_one_after_the_other_mix_no_curve(output: Path, has_encoder: bool, half: int) -> None:
    shelves = [Shelf(has_encoder=has_encoder), Shelf(has_encoder=has_encoder, after=half // 2, url="grpc://other:1")]
    with pytest.raises(InvalidSampleError, match="the same weights_digest, settings_digest at every server"):
        labelled(output, *shelves)
    assert_of_one_checkpoint(stored(output))


def test_servers_of_different_checkpoints_are_refused_at_once(output: Path) -> None:
    shelves = [Shelf(), Shelf(after=0, url="grpc://other:1")]
    with pytest.raises(
        InvalidSampleError, match=r"model rfm: expected the same weights_digest.* got weights-of-v1, .* and"
    ):
        labelled(output, *shelves)
    assert (shelves[0].count, shelves[1].count) == (0, 0)


def test_a_curve_of_several_versions_is_none() -> None:
    score = np.ones(1, np.float32)
    results = [ProgressResult(progress=score, success=score, model_version=version) for version in ("1", "2")]
    with pytest.raises(InferenceFailedError, match="model_version: expected one for all frames, got 1, 2"):
        of_prefixes(results, Sampling("all", None))
