# SPDX-License-Identifier: MIT
"""Another checkpoint is served while a dataset is labelled. The servers are stand-ins, whose checkpoint tests replace."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

from labelling import FEW, LEROBOT
from rfm_client import InvalidSampleError, RewardClient
from rfm_labels import ClientScorer, LabelOptions, label, open_dataset
from shelves import V1, V2, Kept, Shelf

ROOT = LEROBOT / "toy_v30_many"


NUM_EPISODES = 10


def labelled(output: Path, *shelves: Shelf, **options: Any) -> None:
    with RewardClient("", transports=shelves) as client:
        label(open_dataset(ROOT), ClientScorer(client), LabelOptions(output=output, workers=1, **options))


def assert_of_one_checkpoint(output: Path) -> None:
    """Episodes with a part have all progress from the first checkpoint."""
    parts = sorted((output / ".rfm_parts").glob("*.parquet"))
    assert len(parts) < NUM_EPISODES
    for file in parts:
        assert (parquet.read_table(file)["progress"].to_numpy() == np.float32(V1.score)).all()


ALL = ("rfm", "rfm_encoder", "rfm_frames")
REPLACED: dict[str, tuple[Kept, tuple[str, ...], bool]] = {  # and whether embeddings are asked for
    "the one model that there is": (V2, ALL, False),
    "the weights": (Kept(0.9, weights="weights-of-v2"), ALL, False),
    "the settings": (Kept(0.9, settings="settings-of-v2"), ALL, True),
    "the encoder, in the middle of a rollout": (V2, ("rfm_encoder",), True),
}


@pytest.mark.parametrize(("other", "parts", "has_encoder"), REPLACED.values(), ids=REPLACED)
def test_a_run_stops_when_another_checkpoint_is_served(
    output: Path, other: Kept, parts: tuple[str, ...], has_encoder: bool
) -> None:
    changed = r"(_digest: expected \w+-of-v1, got \w+-of-v2|settings_digest: .*); the server changed its checkpoint"
    with pytest.raises(InvalidSampleError, match=changed):
        labelled(output, Shelf(other=other, after=5, parts=parts, has_encoder=has_encoder), **FEW)
    assert list((output / ".rfm_parts").glob("*.parquet"))
    assert_of_one_checkpoint(output)
    assert not (output / "rfm_progress.parquet").exists()


@pytest.mark.parametrize("has_encoder", [True, False], ids=["embeddings", "frames"])
def test_servers_that_are_replaced_one_after_the_other_mix_no_curve(output: Path, has_encoder: bool) -> None:
    shelves = [Shelf(has_encoder=has_encoder), Shelf(has_encoder=has_encoder, after=3, url="grpc://other:1")]
    with pytest.raises(
        InvalidSampleError, match="the same weights_digest, settings_digest and computation at every server"
    ):
        labelled(output, *shelves, limit=4)
    assert_of_one_checkpoint(output)


def test_servers_of_different_checkpoints_are_refused_at_once(output: Path) -> None:
    shelves = [Shelf(), Shelf(after=0, url="grpc://other:1")]
    with pytest.raises(
        InvalidSampleError, match=r"model rfm: expected the same weights_digest.* got weights-of-v1, .* and"
    ):
        labelled(output, *shelves)
    assert (shelves[0].count, shelves[1].count) == (0, 0)
